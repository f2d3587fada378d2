"""The figures of a validation, each made when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from cpunet.analysis.ae_figures import ae_figure, two_dimensional_figure
from cpunet.analysis.baseline_spectra import spectrum_of_noise
from cpunet.analysis.comparisons import data_axis
from cpunet.analysis.figures import (
    cycle_figure,
    loss_curves,
    mean_pulses,
    parameter_histograms,
)
from cpunet.analysis.paired import align_half_maximum
from cpunet.analysis.pulse_figures import single_pulse_figure, spectrum_figure
from cpunet.analysis.slice_figure import slice_figure
from cpunet.jobs.evaluation import Evaluation
from cpunet.jobs.peak_details import PeakDetails
from cpunet.jobs.peak_sets import PeakSets
from cpunet.translation.translator import IREN, REN

Maker = Callable[[], Figure]

# methods in the figures; more lines could not be told apart
DRAWN = ("data", "raw", "gauss_exp", "superpulse", "ren", "truth")
SINGLE = ("raw", "rc", "ren", "truth")  # in the figure of a single pulse
SHOWN = 10  # pulses in a figure of cycles, as in the paper


def figure_makers(found: Evaluation) -> dict[str, Maker]:
    """All figures of a validation by name; nothing is drawn until one is called."""
    makers: dict[str, Maker] = {"spectrum": partial(_spectrum, found)}
    scored = [peak for peak in found.sets if found.values[peak.name]]
    fullest = max(scored, key=lambda s: min(len(s.raw), len(s.data)))
    makers[f"{fullest.name} forward cycle"] = partial(_forward, fullest, found.ren, found.iren)
    makers[f"{fullest.name} backward cycle"] = partial(
        _backward, fullest, found.ren, found.iren
    )
    for peak in scored:
        makers |= _of_peak(peak, found)
    if found.losses:
        makers["losses"] = partial(loss_curves, found.losses)
    return makers


def _of_peak(peak: PeakSets, found: Evaluation) -> dict[str, Maker]:
    name, details = peak.name, found.details[peak.name]
    makers: dict[str, Maker] = {}
    for parameter in found.metrics["peaks"][name]["parameters"]:
        if np.isfinite(found.values[name]["data"][parameter]).any():
            makers[f"{name} {parameter}"] = partial(_histograms, peak, parameter, found)
    makers[f"{name} mean pulse"] = partial(_mean_pulse, peak)
    if _drawable(peak) is not None:
        makers[f"{name} single pulse"] = partial(_single_pulse, peak, found)
    if details.slices:
        makers[f"{name} superpulses"] = partial(_superpulses, details, peak)
    if "missing" not in details.ae_against_time:
        makers[f"{name} A over E"] = partial(_ae, details, name)
    if "missing" not in details.plane:
        makers[f"{name} A over E and drift time"] = partial(_plane, details, name)
    noise = found.metrics["peaks"][name]["noise"]
    if "missing" not in noise["data"]:
        drawn = {m: n for m, n in noise.items() if m in ("frequency_mhz", "data", "ren")}
        makers[f"{name} noise"] = partial(spectrum_of_noise, drawn, name)
    return makers


def _spectrum(found: Evaluation) -> Figure:
    energies = {"data": found.data.energies_kev, "raw": found.sim.energies_kev}
    peaks = {name: peak.energy_kev for name, peak in found.ren.recipe.peaks.items()}
    return spectrum_figure(energies, peaks)


def _histograms(peak: PeakSets, parameter: str, found: Evaluation) -> Figure:
    values = found.values[peak.name]
    by_method = {m: v[parameter] for m, v in values.items() if m in DRAWN}
    axis = data_axis(by_method["data"], found.ren.recipe.scores.max_bins)
    comparison = found.metrics["peaks"][peak.name]["parameters"][parameter]
    return parameter_histograms(by_method, axis, parameter, peak.name, comparison)


def _mean_pulse(peak: PeakSets) -> Figure:
    pulses = {m: p.waveforms for m, p in peak.by_method().items() if m in DRAWN}
    drawn = {method: windows for method, windows in pulses.items() if len(windows)}
    return mean_pulses(drawn, peak.raw.dt_ns, peak.name)


def _drawable(peak: PeakSets) -> int | None:
    """The first simulated event that every method has, with an edge."""
    known = np.ones(len(peak.raw), bool)
    sets = dict(peak.clean) | ({} if peak.truth is None else {"truth": peak.truth})
    for windows in sets.values():
        known &= np.isfinite(windows).all(axis=1)
    for row in np.flatnonzero(known):
        edges = (align_half_maximum(w[row : row + 1], 100, 150) for w in sets.values())
        if all(np.isfinite(edge).any() for edge in edges):
            return int(row)
    return None


def _single_pulse(peak: PeakSets, found: Evaluation) -> Figure:
    row = _drawable(peak)
    assert row is not None  # or there were no such figure
    sets = dict(peak.clean) | ({} if peak.truth is None else {"truth": peak.truth})
    return single_pulse_figure(
        {method: sets[method][row] for method in SINGLE if method in sets},
        peak.data.waveforms,
        peak.raw.dt_ns,
        found.ren.recipe.preparation.samples_before,
        f"{peak.name}, simulated pulse {row}",
    )


def _superpulses(details: PeakDetails, peak: PeakSets) -> Figure:
    drawn = {m: s for m, s in details.slices.items() if m in ("data", "superpulse", "ren")}
    return slice_figure(drawn, peak.raw.dt_ns, peak.name)


def _ae(details: PeakDetails, name: str) -> Figure:
    table = dict(details.ae_against_time)
    table["methods"] = {m: rows for m, rows in table["methods"].items() if m in DRAWN}
    return ae_figure(table, name)


def _plane(details: PeakDetails, name: str) -> Figure:
    table = dict(details.plane)
    shown = ("data", "raw", "ren", "truth")
    table["counts"] = {m: c for m, c in table["counts"].items() if m in shown}
    return two_dimensional_figure(table, name)


def _forward(peak: PeakSets, ren: REN, iren: IREN) -> Figure:
    """Ten simulated pulses there and back again."""
    sim = peak.raw.waveforms[:SHOWN]
    like_data = ren.apply(sim, noise=False)
    titles = ("Simulation", "REN (simulation)", "IREN (REN (simulation))")
    return cycle_figure(sim, like_data, iren.apply(like_data, noise=False), titles, ren.dt_ns)


def _backward(peak: PeakSets, ren: REN, iren: IREN) -> Figure:
    """Ten measured pulses there and back again."""
    data = peak.data.waveforms[:SHOWN]
    like_sim = iren.apply(data, noise=False)
    titles = ("Data", "IREN (data)", "REN (IREN (data))")
    return cycle_figure(data, like_sim, ren.apply(like_sim, noise=False), titles, ren.dt_ns)
