"""Draw one pulse through every step, from its hits to its parameters; run by hand."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from cpunet.electronics.chain import read_electronics
from cpunet.electronics.readout import RawTraces, read_out
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import pulse_parameters
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe
from cpunet.simulation.gammas import EnergyWindow, simulate_gammas
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator, merge_hits

PICTURE = Path(__file__).parents[1] / "pictures" / "one-pulse.png"
EVENT = 5  # one with several sites, of which pulses can be told apart
SIM, DATA, GREY = "#d55e00", "#0072b2", "0.65"


def hits_of_an_event(detector: Detector) -> Hits:
    """A full-energy event of Tl-208 in the detector, its hits merged."""
    wanted = {EnergyWindow("FEP", 2614.0, 2615.0): 10}
    hits, _ = simulate_gammas(
        detector,
        source_height_mm=20,
        source_radius_mm=5,
        n_primaries=10**6,
        seed=1,
        wanted=wanted,
    )
    hits = merge_hits(hits, SimulationSettings().cluster_mm, detector)
    return hits[np.argsort(hits.event_number)[[EVENT]]]


def draw_hits(panel: Axes, detector: Detector, hits: Hits) -> None:
    x, z = np.meshgrid(np.linspace(-45, 45, 361), np.linspace(-3, 100, 413))
    active = detector.active(abs(x), z)
    panel.contourf(x, z, active, levels=[0.5, 1], colors=["0.92"])
    panel.contour(x, z, active, levels=[0.5], colors=["0.4"], linewidths=0.8)
    panel.scatter(hits.x_mm, hits.z_mm, s=hits.edep_kev / 8, color=SIM, alpha=0.7, lw=0)
    panel.set(xlabel="x [mm]", ylabel="z [mm]", aspect="equal")


def draw_charge(panel: Axes, simulator: Simulator, hits: Hits, charge: Pulses) -> None:
    single = simulator.signals(hits.x_mm, hits.y_mm, hits.z_mm, hits.edep_kev)
    for pulse, kev in zip(single.waveforms, hits.edep_kev, strict=True):
        panel.plot(pulse * kev / hits.energy_kev[0], color=SIM, lw=0.7, alpha=0.6)
    panel.plot(charge.waveforms[0], color="black")
    panel.set(xlabel="time [ns]", ylabel="induced charge", xlim=(0, 2500))


def draw_response(panel: Axes, charge: Pulses, traces: RawTraces) -> None:
    half = (charge.waveforms[0] > 0.5).argmax()
    panel.plot(np.arange(len(charge.waveforms[0])) - half, charge.waveforms[0], color=GREY)
    response = traces.response[0]
    half = (response > response.max() / 2).argmax()
    panel.plot((np.arange(len(response)) - half) * traces.dt_ns, response, color=DATA)
    panel.set(xlabel="time from half height [ns]", ylabel="response", xlim=(-1500, 4000))


def draw_trace(panel: Axes, traces: RawTraces) -> None:
    time_us = np.arange(traces.waveforms.shape[1]) * traces.dt_ns / 1000
    panel.plot(time_us, traces.waveforms[0], color=DATA, lw=0.8)
    panel.set(xlabel="time [µs]", ylabel="ADC counts")
    closer = panel.inset_axes((0.56, 0.2, 0.4, 0.4))
    closer.plot(time_us[:400], traces.waveforms[0, :400], color=DATA, lw=0.6)
    closer.tick_params(labelsize=7)
    closer.set_title("baseline", fontsize=8)


def draw_window(panel: Axes, window: Pulses) -> None:
    panel.plot(window.waveforms[0], color=DATA, lw=0.8)
    panel.axvline(400, color=GREY, lw=0.8)
    for level in (0, 0.8):
        panel.axhline(level, color=GREY, lw=0.8)
    panel.text(390, 0.3, "half of\nits height", ha="right", fontsize=8)
    panel.text(8, 0.83, "0.80: last 80 ns", fontsize=8)
    panel.set(xlabel="sample", ylabel="prepared pulse", xlim=(0, 799), ylim=(-0.08, 1))


def draw_parameters(panel: Axes, window: Pulses) -> None:
    recipe = load_recipe("fast").at(window.dt_ns)
    values = pulse_parameters(window, recipe.preparation, recipe.scores)
    pulse, dt_ns = window.waveforms[0], window.dt_ns
    time, top = np.arange(len(pulse)) * dt_ns / 1000, pulse.argmax()
    panel.plot(time, pulse, color=DATA, lw=0.8)
    current = np.diff(pulse)
    panel.plot(time[1:], current / current.max() * 0.5, color=SIM, lw=0.8)
    steep = current.argmax() + 1
    amplitude = values["current_amplitude"][0]
    panel.annotate(
        f"$I_{{max}}$ = {amplitude:.4f} per sample",
        (time[steep], 0.5),
        (time[steep] + 0.5, 0.3),
        fontsize=8,
        arrowprops={"arrowstyle": "->", "color": SIM},
    )
    drift_ns = values["drift_time"][0]
    start = time[top] - drift_ns / 1000
    panel.annotate("", (start, 0.99), (time[top], 0.99), arrowprops={"arrowstyle": "<->"})
    panel.text(
        time[top] + 0.2, 0.97, f"$T_{{drift}}$ = {values['drift_time'][0]:.0f} ns", fontsize=8
    )
    tail = slice(-recipe.preparation.decay_fit_samples, None)
    middle = np.log(pulse[tail]).mean()
    fit = np.exp(middle + values["tail_slope"][0] / 1000 * (time[tail] - time[tail].mean()))
    panel.plot(time[tail], fit, color="black", lw=1.5)
    slope = values["tail_slope"][0]
    panel.text(time[-1] - 0.1, 0.6, f"slope {slope:.1f} / ms", fontsize=8, ha="right")
    panel.set(xlabel="time [µs]", ylabel="pulse and current", ylim=(-0.08, 1.09))
    panel.set_xlim(time[steep] - 4, time[-1])


def main() -> None:
    detector = read_detector("icpc")
    simulator = Simulator(detector, SimulationSettings(dt_ns=1))
    hits = hits_of_an_event(detector)
    charge = simulator.events(hits).pulses()
    traces = read_out(charge, read_electronics("ornl"), seed=3)
    raw = Pulses.of(traces.waveforms, dt_ns=traces.dt_ns, energy_kev=traces.energy_kev)
    window = prepare(raw, load_recipe("fast").preparation, "measured").pulses
    figure, panels = plt.subplots(2, 3, figsize=(10, 5.6), layout="constrained")
    titles = "hits", "charge", "readout chain", "noise: the trace", "window", "parameters"
    for number, (panel, title) in enumerate(zip(panels.flat, titles, strict=True), 1):
        panel.set_title(f"{number}. {title}", fontsize=11, loc="left")
    draw_hits(panels[0, 0], detector, hits)
    draw_charge(panels[0, 1], simulator, hits, charge)
    draw_response(panels[0, 2], charge, traces)
    draw_trace(panels[1, 0], traces)
    draw_window(panels[1, 1], window)
    draw_parameters(panels[1, 2], window)
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main()
