"""Figures of energies and of single pulses, as in the paper (Bhimani et al. 2026).

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

from cpunet.electronics.window_response import fitted_tail_slope, without_decay
from cpunet.errors import CpunetError
from cpunet.plotting import DATA_FILL, GROUP, colours, label, linear_within, styled
from cpunet.pulses.container import FloatArray
from cpunet.pulses.half_maximum import align_half_maximum
from cpunet.validation.nearest import nearest_pulses

Values = npt.NDArray[np.float64]

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

    Raises
    ------
    CpunetError
        If no energy is finite.
    """
    finite = {m: values[np.isfinite(values)] for m, values in energy_kev.items()}
    everything = np.concatenate([np.empty(0), *finite.values()])
    if not everything.size:
        raise CpunetError("no pulse has an energy to draw; give a calibration")
    low, high = _drawn_range(everything)
    width = max(BIN_KEV, (high - low) / MAX_BINS)
    edges = np.arange(np.floor(low / width), np.floor(high / width) + 2) * width
    palette = colours(finite)
    figure = Figure(figsize=(7.5, 4.0))
    axes = figure.subplots()
    for method, values in finite.items():
        is_data = method == "data"
        counts = np.histogram(values, edges)[0] / max(len(values), 1) / width
        unknown = len(energy_kev[method]) - len(values)
        axes.stairs(
            counts,
            edges,
            fill=is_data,
            facecolor=DATA_FILL if is_data else None,
            edgecolor="0.5" if is_data else palette[method],
            linewidth=0.5 if is_data else 1.0,
            label=f"{label(method)}, n = {len(values)}"
            + (f", {unknown} without energy" if unknown else ""),
            gid=GROUP + method,
        )
    axes.set(yscale="log", xlabel="Energy [keV]", ylabel="Fraction of events per keV")
    _mark_peaks(axes, peaks, (float(edges[0]), float(edges[-1])))
    figure.legend(loc="outside upper left", ncols=len(finite))
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

    Raises
    ------
    CpunetError
        If the target or all pulses lack a crossing of half the maximum.

    Examples
    --------
    >>> time = np.arange(400.0)
    >>> pulses = np.array([1 / (1 + np.exp((200 - time) / width)) for width in (2, 5, 9)])
    >>> nearest(pulses, pulses[1])[0]
    1
    """
    wanted = align_half_maximum(target[np.newaxis], BEFORE, AFTER)
    if not np.isfinite(wanted).any():
        raise CpunetError("the pulse to compare with never crosses half of its maximum")
    found = nearest_pulses(wanted, windows, 1, BEFORE, least=0.5)
    if not found.index.size:
        raise CpunetError("no measured pulse crosses half of its maximum; check the file")
    return int(found.index[0, 0]), float(found.rms[0, 0])


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

        The simulated pulse is that of ``"ren"``, or else of ``"truth"``, or else the first.
        `data` are measured windows of shape ``(n, length)``; for the other parameters see
        `single_pulse_figure`.

        Raises
        ------
        CpunetError
            If there are no pulses, or if the pulse or all data lack an edge or a tail.
        """
        if not pulses:
            raise CpunetError("no pulse to draw; give one by method")
        target = next((name for name in TARGETS if name in pulses), next(iter(pulses)))
        row, rms = nearest(data, pulses[target])
        slope = fitted_tail_slope(data, dt_ns, samples_before)
        return cls(row, rms, target, data[row], slope)


@styled
def single_pulse_figure(
    pulses: Mapping[str, FloatArray],
    data: DataPulse,
    dt_ns: float,
    samples_before: int,
    title: str = "",
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

    Raises
    ------
    CpunetError
        If one of the pulses has no edge.
    """
    shown = {"data": data.window} | dict(pulses)
    slope = data.slope_per_ms
    windows = {m: np.asarray(w, np.float32)[np.newaxis] for m, w in shown.items()}
    figure = Figure(figsize=(9.5, 7.6))
    grid = figure.subplots(3, 2, sharey="row", sharex="col", height_ratios=(4, 4, 3))
    _draw(list(grid[0]), windows, dt_ns)  # refuses a pulse without an edge
    corrected = {
        m: without_decay(w, 0.0 if m == UNDECAYED else slope, dt_ns, samples_before).astype(
            np.float32
        )
        for m, w in windows.items()
    }
    _draw(list(grid[1]), corrected, dt_ns)
    _draw_differences(list(grid[2]), corrected, dt_ns)
    grid[0, 0].set(ylabel="Pulse height", title="As prepared")
    grid[0, 1].set(title="Edge", xlim=ZOOM_NS)
    grid[1, 0].set(ylabel="Pulse height,\nplateau = 1")
    grid[1, 0].set_title(f"Corrected for a decay of {_decay(slope)}")
    grid[1, 1].set_title("Edge, corrected")
    grid[2, 0].set_ylabel("Corrected: method −\ndata pulse [%]")
    for axes in grid[2]:
        axes.set_xlabel("Time from half maximum [ns]")
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(),
        loc="outside upper left",
        ncols=len(shown),
        title=f"{title + ': ' if title else ''}data pulse {data.row} is nearest to "
        f"“{label(data.target)}”, RMS {data.rms:.4f}",
        alignment="left",
    )
    return figure


def _mark_peaks(axes: Axes, peaks: Mapping[str, float], span: tuple[float, float]) -> None:
    from matplotlib.transforms import blended_transform_factory

    place = blended_transform_factory(axes.transData, axes.transAxes)
    inside = sorted((e, name) for name, e in peaks.items() if span[0] <= e <= span[1])
    previous, level = -np.inf, 0
    for energy, name in inside:
        # the names of neighbouring lines are stacked
        close = energy - previous < 0.06 * (span[1] - span[0])
        previous, level = energy, (level + 1) % 3 if close else 0
        axes.axvline(energy, color="0.5", linewidth=0.9, linestyle=":", zorder=0)
        axes.text(energy, 1.01 + 0.05 * level, name, transform=place, ha="center", size=8.5)


def _draw(panels: list[Axes], windows: Mapping[str, FloatArray], dt_ns: float) -> None:
    palette = colours(windows)
    for method, window in windows.items():
        time_ns, pulse = _aligned(method, window, dt_ns)
        # a broad grey line, so that a method which agrees does not hide the data
        look: dict[str, Any] = (
            {"color": "0.65", "linewidth": 3.5}
            if method == "data"
            else {"color": palette[method], "linewidth": 1.2}
        )
        if method == "truth":  # on top of methods that agree with it
            look["linestyle"] = "--"
        for axes in panels:
            axes.plot(time_ns, pulse, label=label(method), gid=GROUP + method, **look)


def _draw_differences(
    panels: list[Axes], windows: Mapping[str, FloatArray], dt_ns: float
) -> None:
    palette = colours(windows)
    time_ns, data = _aligned("data", windows["data"], dt_ns)
    for method, window in windows.items():
        if method == "data":
            continue
        difference = 100 * (_aligned(method, window, dt_ns)[1] - data)
        for axes in panels:
            axes.plot(
                time_ns, difference, color=palette[method], linewidth=1.0, gid=GROUP + method
            )
    for axes in panels:
        axes.axhline(0, color="black", linewidth=0.8)
    linear_within(panels[0], LINEAR)


def _aligned(method: str, window: FloatArray, dt_ns: float) -> tuple[Values, FloatArray]:
    """Time from the crossing in ns and the pulse, NaN outside its record."""
    length = window.shape[1]
    pulse = align_half_maximum(window, length, length)[0]
    if not np.isfinite(pulse).any():
        raise CpunetError(
            f"the pulse of “{label(method)}” never crosses half of its maximum; choose another"
        )
    return (np.arange(2 * length) - length) * dt_ns, pulse


def _decay(slope_per_ms: float) -> str:
    return f"{-1e3 / slope_per_ms:.3g} µs" if slope_per_ms else "none"
