"""Figures of energies, single pulses and pile-up tails (Bhimani et al. 2026 for the former).

It is unknown which simulated and which measured pulses come from the same position.  A
simulated pulse is therefore shown beside the measured one nearest to its translation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import blended_transform_factory

from cpunet.electronics.baseline_methods import fitted_tail_slope, without_decay
from cpunet.electronics.tails_law import TailsLaw
from cpunet.plotting import (
    COLOURS,
    colours,
    label,
    legend_above,
    legend_height,
    line_look,
    linear_within,
    logarithmic,
    panels,
    steps,
    styled,
)
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import BLOCK, Values, align_half_maximum

BIN_KEV = 2.0  # or more, if there would be too many bins
MAX_BINS = 2000
HIGHEST = 0.999  # quantile; an axis that would be too long ends a little above it
BEFORE, AFTER = 100, 150  # samples around the crossing that define the nearest pulse
LINEAR = 1.0  # percent of full charge, up to which the scale of differences is linear
ZOOM_NS = (-600.0, 800.0)
UNDECAYED = "raw"  # the method without a decay to correct
TARGETS = ("ren", "truth", "raw")  # methods to which the measured pulse is matched, best first


@styled
def spectrum_figure(energy_kev: Mapping[str, Values], peaks: Mapping[str, float]) -> Figure:
    """Energy spectra of both sides, each normalised to one, with the gamma lines marked.

    Parameters
    ----------
    energy_kev
        Energies in keV by method, the measured ones under ``"data"``; ``"raw"`` is the
        simulation.
    peaks
        Energy of each line in keV, by name.
    """
    finite = {m: values[np.isfinite(values)] for m, values in energy_kev.items()}
    low, high = _drawn_range(np.concatenate([*finite.values()]))
    width = max(BIN_KEV, (high - low) / MAX_BINS)
    edges = np.arange(np.floor(low / width), np.floor(high / width) + 2) * width
    palette = colours(finite)
    figure, ((axes,),) = panels((7.5, 4.2), top=0.85)
    for method, values in finite.items():
        counts = np.histogram(values, edges)[0] / max(len(values), 1) / width
        unknown = len(energy_kev[method]) - len(values)
        text = f"{label(method)}, n = {len(values)}"
        text += f", {unknown} without energy" if unknown else ""
        colour = "0.5" if method == "data" else palette[method]
        steps(axes, counts, edges, method, colour, text)
    axes.set(yscale="log", xlabel="Energy [keV]", ylabel="Fraction of events per keV")
    logarithmic(axes.yaxis)
    _mark_peaks(axes, peaks, (float(edges[0]), float(edges[-1])))
    legend_above(figure, axes, len(finite))
    return figure


def _drawn_range(energy_kev: Values) -> tuple[float, float]:
    """Ends of the axis: those of the energies, unless a few outliers would widen all bins."""
    ends = float(energy_kev.min()), float(energy_kev.max())
    if ends[1] - ends[0] <= MAX_BINS * BIN_KEV:
        return ends
    low = float(np.quantile(energy_kev, 1 - HIGHEST, method="higher"))
    high = float(np.quantile(energy_kev, HIGHEST, method="lower"))
    if high <= low:
        return ends
    margin = 0.05 * (high - low)
    return max(ends[0], low - margin), min(ends[1], high + margin)


def nearest(windows: FloatArray, target: FloatArray) -> tuple[int, float]:
    """The pulse with the smallest RMS difference from another, aligned at half maximum.

    Noise contributes to the difference.  Pulses with less than half of the compared samples
    in their record are left out.

    Parameters
    ----------
    windows
        Pulses to choose from, shape ``(n, length)``.
    target
        Pulse to compare with, shape ``(length,)``.

    Returns
    -------
    tuple
        Row of the pulse, and its RMS difference from 100 samples before the crossing to 150
        after it, in pulse heights.

    Examples
    --------
    >>> time = np.arange(400.0)
    >>> pulses = np.array([1 / (1 + np.exp((200 - time) / width)) for width in (2, 5, 9)])
    >>> nearest(pulses, pulses[1])[0]
    1
    """
    wanted = align_half_maximum(target[np.newaxis], BEFORE, AFTER).astype(float)
    squares = np.empty(len(windows))
    for first in range(0, len(windows), BLOCK):
        rows = slice(first, first + BLOCK)
        aligned = align_half_maximum(windows[rows], BEFORE, AFTER)
        apart = np.square(aligned - wanted)
        known = np.isfinite(apart)
        mean = np.where(known, apart, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        enough = np.isfinite(aligned).sum(axis=1) >= 0.5 * np.isfinite(wanted).sum()
        squares[rows] = np.where(enough & known.any(axis=1), mean, np.inf)
    row = int(squares.argmin())
    return row, float(np.sqrt(squares[row]))


class DataPulse(NamedTuple):
    """The measured pulse that is shown beside simulated ones.

    Parameters
    ----------
    row
        Row of the pulse among the measured pulses.
    rms
        RMS difference from the simulated pulse, see `nearest`.
    target
        Method of that simulated pulse.
    window
        Prepared pulse, shape ``(length,)``.
    slope_per_ms
        Median slope of the tails of all measured pulses in 1/ms.
    """

    row: int
    rms: float
    target: str
    window: FloatArray
    slope_per_ms: float

    @classmethod
    def beside(
        cls,
        pulses: Mapping[str, FloatArray],
        data: FloatArray,
        dt_ns: float,
        samples_before: int,
    ) -> Self:
        """Choose the measured window nearest to a simulated pulse.

        The simulated pulse is that of ``"ren"``, or else of ``"truth"`` or ``"raw"``.
        `data` are measured windows of shape ``(n, length)``; for the other parameters see
        `single_pulse_figure`.
        """
        target = next(name for name in TARGETS if name in pulses)
        row, rms = nearest(data, pulses[target])
        slope = fitted_tail_slope(data, dt_ns, samples_before)
        return cls(row, rms, target, data[row], slope)


@styled
def single_pulse_figure(
    pulses: Mapping[str, FloatArray],
    data: DataPulse,
    dt_ns: float,
    samples_before: int,
    title: str,
) -> Figure:
    """One simulated pulse by every method beside the nearest measured pulse.

    The upper panels show the pulses as prepared.  The lower panels show them pole-zero
    corrected with the median slope of the measured tails, at unit height, and their
    differences from the measured pulse including its noise.  The simulation without
    electronics has no decay and is not corrected.  All pulses are aligned at half maximum;
    the right column shows their edges.

    Parameters
    ----------
    pulses
        The pulse by method, each of shape ``(length,)``: ``"raw"``, ``"rc"``, ``"ren"``, ….
        Noise-free pulses show the electronics alone.
    data
        Measured pulse for comparison.
    dt_ns
        Sampling period in ns.
    samples_before
        Sample of the windows' alignment, after which the tail begins.
    title
        Title of the figure, for example ``"SEP, event 12"``.
    """
    shown = {"data": data.window} | dict(pulses)
    slope, length = data.slope_per_ms, len(data.window)
    aligned, corrected = {}, {}
    for method, pulse in shown.items():
        window = np.asarray(pulse, np.float32)[np.newaxis]
        undecayed = without_decay(
            window, 0.0 if method == UNDECAYED else slope, dt_ns, samples_before
        )
        pair = np.concatenate([window, undecayed.astype(np.float32)])
        aligned[method], corrected[method] = align_half_maximum(pair, length, length)
    differences = {
        m: 100 * (p - corrected["data"]) for m, p in corrected.items() if m != "data"
    }
    time_ns = np.arange(-length, length) * float(dt_ns)
    shared: dict[str, Any] = {"sharey": "row", "sharex": "col", "height_ratios": (4, 4, 3)}
    top = legend_height(1) + 0.25
    figure, grid = panels((9.5, 7.6), 3, 2, top=top, between=(0.2, 0.4), **shared)
    for line, drawn in zip(grid, (aligned, corrected, differences), strict=True):
        for axes in line:
            _draw(axes, time_ns, drawn)
    for axes in grid[2]:
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set_xlabel("Time from half maximum [ns]")
    linear_within(grid[2, 0], LINEAR)
    decay = f"{-1e3 / slope:.3g} µs" if slope else "none"
    grid[0, 0].set(ylabel="Pulse height", title="As prepared")
    grid[0, 1].set(title="Edge", xlim=ZOOM_NS)
    grid[1, 0].set(
        ylabel="Pulse height,\nplateau = 1", title=f"Corrected for a decay of {decay}"
    )
    grid[1, 1].set_title("Edge, corrected")
    grid[2, 0].set_ylabel("Corrected: method −\ndata pulse [%]")
    beside = f"data pulse {data.row} is nearest to “{label(data.target)}”, RMS {data.rms:.4f}"
    legend_above(figure, grid[0, 0], len(shown), f"{title}: {beside}")
    return figure


@styled
def tails_figure(summary: Mapping[str, Any]) -> Figure:
    """Sizes of the pile-up tails with their law, from the values stored with a training.

    Parameters
    ----------
    summary
        Result of `PileUpTails.describe`, with ``sizes``: ``kev``, and ``percent_above``, the
        percentages of the traces above each; and ``drawn``, with quantiles of the energies of
        earlier pulses in keV.
    """
    figure, ((axes,),) = panels((5.2, 3.4))
    kev, percent = (np.asarray(summary["sizes"][k], float) for k in ("kev", "percent_above"))
    # binomial error of a fraction of n traces
    share, n = percent / 100, max(summary["traces"], 1)
    error = np.sqrt(share * (1 - share) / n)
    axes.fill_between(
        kev, 100 * (share - error), 100 * (share + error), color=COLOURS["data"], alpha=0.3
    )
    axes.loglog(kev, 100 * share, color=COLOURS["data"], label=f"measured, {n:,} traces")
    energies_kev = tuple(summary["drawn"]["energies_kev"])
    law = TailsLaw(summary["rate_khz"], summary["decay_us"], energies_kev)
    axes.loglog(kev, 100 * law.share_above(kev), color=COLOURS["ren"], label="law")
    twice = 2 * summary["error_kev"]
    axes.axvline(twice, color="0.6", lw=0.8, ls=":", label="twice the error of a size")
    axes.set_title(
        f"{summary['rate_khz']:.2f} ± {summary['rate_error_khz']:.2f} kHz, "
        f"decay {summary['decay_us']:.1f} µs"
    )
    axes.set_ylim(max(30 / n, 0.01), 100)
    logarithmic(axes.xaxis)
    logarithmic(axes.yaxis)
    axes.set_xlabel("tail at the first sample (keV)")
    axes.set_ylabel("traces above (%)")
    axes.legend()
    return figure


def _mark_peaks(axes: Axes, peaks: Mapping[str, float], span: tuple[float, float]) -> None:
    place = blended_transform_factory(axes.transData, axes.transAxes)
    inside = sorted((e, name) for name, e in peaks.items() if span[0] <= e <= span[1])
    previous, level = -np.inf, 0
    for energy, name in inside:
        # the names of neighbouring lines are stacked
        close = energy - previous < 0.06 * (span[1] - span[0])
        previous, level = energy, (level + 1) % 3 if close else 0
        axes.axvline(energy, color="0.5", linewidth=0.9, linestyle=":", zorder=0)
        axes.text(energy, 1.01 + 0.05 * level, name, transform=place, ha="center", size=8.5)


def _draw(axes: Axes, time_ns: npt.NDArray[Any], pulses: Mapping[str, FloatArray]) -> None:
    palette = colours(pulses)
    for method, pulse in pulses.items():
        look = line_look(method, palette[method])
        if method != "data":
            look["linewidth"] = 1.2
        if method == "truth":  # on top of methods that agree with it
            look["linestyle"] = "--"
        axes.plot(time_ns, pulse, label=label(method), **look)
