"""Figures of a training: both sides of it, readout chains, and losses of networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cpunet.errors import CpunetError
from cpunet.plotting import COLOURS, DATA_FILL, SPARE_COLOURS, label, panels, styled
from cpunet.pulses.parameters import align_half_maximum
from cpunet.training.chain_description import TIMES_NS, Chain, reaches_ns

Floats = npt.NDArray[np.floating]

PULSES, EDGE_NS, SIDE_BINS = 12, (-500.0, 500.0), 40  # pulses drawn of each side
STEP_NS, IMPULSE_NS, GRID_NS = 2000.0, 600.0, 1.0
LAYOUT = (("step", "impulse"), ("residual", "impulse"), ("tail", "noise"))
POINTS = 400  # of the tail, equidistant on the logarithmic axis
NOISE_BINS = 150  # of the noise spectra
SIGMAS = 2.0  # of the band about a step response
AVERAGES = 50  # a moving average is over this fraction of the records


@styled
def sides_figure(
    waveforms: Mapping[str, Floats],
    parameters: Mapping[str, Mapping[str, Floats]],
    dt_ns: float,
    counts: Mapping[str, int],
) -> Figure:
    """Pulses aligned at half maximum with their edges (top), histograms (bottom).

    Parameters
    ----------
    waveforms
        Pulses of unit height, shape (pulses, samples), of ``"raw"`` (the simulation) and
        ``"data"``.
    parameters
        Values of two quantities by axis label and side.
    dt_ns
        Sampling period in ns.
    counts
        Number of pulses that each side has in all.
    """
    figure = Figure(figsize=(9.0, 6.0))
    (whole, edge), below = figure.subplots(2, 2)
    for side, pulses in waveforms.items():
        shown = min(len(pulses), PULSES)
        some = pulses[np.linspace(0, len(pulses) - 1, shown).astype(int)]
        length = pulses.shape[1]
        aligned = align_half_maximum(np.asarray(some, np.float32), length, length)
        time_ns = (np.arange(2 * length) - length) * dt_ns
        colour = COLOURS[side] if side != "data" else "0.35"
        look: dict[str, Any] = {"color": colour, "linewidth": 0.7, "alpha": 0.8}
        for axes, scale in ((whole, 1e-3), (edge, 1.0)):  # µs, ns
            lines = axes.plot(scale * time_ns, aligned.T, **look)
            lines[0].set_label(f"{label(side)}, {shown} of {counts[side]}")
    title, height = "Pulses, aligned at half of their maximum", "Charge / its maximum"
    whole.set(title=title, xlabel="Time [µs]", ylabel=height)
    edge.set(title="Their edges", xlabel="Time [ns]", ylabel=height, xlim=EDGE_NS)
    for axes, (name, values) in zip(below, parameters.items(), strict=True):
        everything = np.concatenate([v[np.isfinite(v)] for v in values.values()])
        low, high = np.quantile(everything, (0.002, 0.998))
        edges = np.linspace(low, high, SIDE_BINS + 1)
        for side, own in values.items():
            counted, data = np.histogram(own, edges)[0] / max(len(own), 1), side == "data"
            colour = DATA_FILL if data else COLOURS[side]
            axes.stairs(counted, edges, fill=data, color=colour, label=label(side))
        axes.set(xlabel=name, ylabel="Fraction of pulses")
        axes.legend()
    figure.legend(*whole.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


@styled
def response_figure(
    chains: Sequence[Chain], truth: Chain | None = None, *, tail_ns: float
) -> Figure:
    """Step response and its residuals, impulse response, tail, and spectrum of the noise.

    Times are counted from half height, by which pulses are aligned: an overall delay of the
    chain cannot be inferred from them.  Residuals are differences from the truth.

    Parameters
    ----------
    chains
        Fitted chains.
    truth
        True chain, if given.
    tail_ns
        Time after the step up to which the tail is drawn, in ns.
    """
    rows = [row for row in LAYOUT if truth is not None or "residual" not in row]
    heights = [1.3 if "residual" in row else 2.2 for row in rows]
    figure = Figure(figsize=(10.5, 2.4 + sum(heights)))
    panels = figure.subplot_mosaic([list(row) for row in rows], height_ratios=heights)
    shades = [COLOURS["ren"], *SPARE_COLOURS]
    drawn = [(chain, shades[i % len(shades)], 1.2) for i, chain in enumerate(chains)]
    if truth is not None:
        # a broad line underneath, so that a chain which agrees does not hide it
        drawn.insert(0, (truth, COLOURS["truth"], 3.5))
    long_ns = np.arange(-100.0, STEP_NS, GRID_NS)
    short_ns = np.arange(-150.0, IMPULSE_NS, GRID_NS)
    tail = np.geomspace(100.0, tail_ns, POINTS)
    steps, errors = [], []
    for chain, colour, width in drawn:
        half_ns, band = reaches_ns(chain.step(TIMES_NS), 0.5), np.zeros(len(long_ns))
        steps.append(chain.step(long_ns + half_ns))
        look: dict[str, Any] = {"color": colour, "linewidth": width}
        panels["step"].plot(long_ns, steps[-1], label=chain.name, **look)
        if chain.draws is not None:
            band = SIGMAS * np.sqrt((chain.draws(long_ns + half_ns) ** 2).sum(axis=-1))
            text = f"± {SIGMAS:g} standard deviations"
            around = steps[-1] - band, steps[-1] + band
            panels["step"].fill_between(long_ns, *around, color=colour, alpha=0.3, label=text)
        errors.append(band)
        early, late = (chain.step(short_ns + half_ns + end * GRID_NS / 4) for end in (-1, 1))
        panels["impulse"].plot(short_ns, 2e3 * (late - early) / GRID_NS, **look)
        panels["tail"].plot(1e-3 * tail, chain.step(tail + half_ns), **look)
        if chain.noise is None:
            continue
        # equidistant on the logarithmic axis: low frequencies individually, high ones averaged
        stop = len(chain.noise[0]) - 1
        edges = np.unique(np.geomspace(1, stop, NOISE_BINS).astype(int))
        frequency, density = (
            np.add.reduceat(values[:stop], edges[:-1]) / np.diff(edges)
            for values in chain.noise
        )
        panels["noise"].loglog(frequency, density, **look)
    if truth is not None:
        axes, reference = panels["residual"], steps.pop(0)
        for (_, colour, _), step, error in zip(drawn[1:], steps, errors[1:], strict=True):
            difference, band = 1e3 * (step - reference), 1e3 * error
            axes.plot(long_ns, difference, color=colour)
            around = difference - band, difference + band
            axes.fill_between(long_ns, *around, color=colour, alpha=0.3)
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set(ylabel="Run − truth\n[10⁻³ of full charge]")
    _annotate(panels)
    return figure


def _annotate(panels: dict[str, Axes]) -> None:
    steps = [panels[name] for name in ("step", "residual") if name in panels]
    for axes in steps:
        axes.set(xlim=(-100, STEP_NS))
        axes.tick_params(labelbottom=axes is steps[-1])
    steps[-1].set(xlabel="Time from half height [ns]")
    height, density = "Height [full charge]", "Density [keV²/MHz]"
    panels["step"].set(title="Step response", ylabel=height)
    panels["step"].legend(loc="lower right")
    time = "Time from half height of the step [ns]"
    panels["impulse"].set(title="Impulse response", xlabel=time, ylabel="Current [1/µs]")
    time = "Time from half height [µs]"
    panels["tail"].set(title="Top and tail of the step", xlabel=time, ylabel=height)
    panels["tail"].set(xscale="log")
    panels["noise"].set(title="Noise", xlabel="Frequency [MHz]", ylabel=density)
    for name in ("tail", "noise"):
        panels[name].xaxis.set_major_formatter("{x:g}")
    if not panels["noise"].lines:
        panels["noise"].set_axis_off()


@styled
def loss_curves(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Losses during the training, and how often critics were right, each kind in a panel.

    Records are faint, moving averages on top of them; dashed lines are of pulses that critics
    have not seen.

    Parameters
    ----------
    records
        Records of the training log: ``{"iteration": i, "losses": {name: value, …}}``, in
        order.

    Raises
    ------
    CpunetError
        If there are no records.
    """
    if not records:
        raise CpunetError("the training log is empty: there are no losses to draw; train first")
    drawn = [
        (part, name)
        for part in ("losses", "accuracy")
        for name in dict.fromkeys(name for record in records for name in record.get(part, ()))
    ]
    kinds = [name.partition("_")[0] if part == "losses" else part for part, name in drawn]
    shown = list(dict.fromkeys(kinds))
    figure, (grid,) = panels((1.4 + 3.2 * len(shown), 3.6), 1, len(shown))
    for (part, name), kind in zip(drawn, kinds, strict=True):
        axes = grid[shown.index(kind)]
        # critics are not updated, and cycles not visited, in every iteration
        present = [record for record in records if name in record.get(part, ())]
        at = [record["iteration"] for record in present]
        series = [record[part][name] for record in present]
        width = max(1, len(series) // AVERAGES)
        average = np.convolve(series, np.full(width, 1 / width), mode="valid")
        style = "--" if name.endswith("unseen") else "-"
        (line,) = axes.plot(at[width - 1 :], average, style, label=name.replace("_", " "))
        axes.plot(at, series, color=line.get_color(), alpha=0.25, linewidth=0.7)
        axes.set(xlabel="Iteration (lines: moving averages)")
        axes.set_yscale("log" if part == "losses" else "linear")
        axes.legend()
    grid[0].set_ylabel("Loss")
    if shown[-1] == "accuracy":
        grid[-1].set(ylabel="Part of pairs ordered rightly", ylim=(0.4, 1.02))
        grid[-1].axhline(0.5, color="black", linewidth=0.8)
    return figure
