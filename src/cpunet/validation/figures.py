"""Figures of a training and of its validation; each function returns a `Figure`.

Only matplotlib's object-oriented interface is used.  Without global state, figures can be
made in worker processes and notebooks alike.  The caller saves them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from hist.axis import Regular
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cpunet.plotting import (
    COLOURS,
    DATA_FILL,
    GROUP,
    LINE,
    STACKED,
    label,
    legend_above,
    line,
    panels,
    points,
    steps,
    styled,
)
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import Values
from cpunet.pulses.shape_parameters import LABELLED, data_axis
from cpunet.tables import number
from cpunet.validation.a_over_e import DEP
from cpunet.validation.ae_energy import REFERENCE_KEV, Course, columns
from cpunet.validation.comparisons import Compared, finite_values, histogram
from cpunet.validation.metrics import QUANTITIES, Metrics
from cpunet.validation.noise import Spectrum
from cpunet.validation.peaks import BEFORE_NS, MeanPulse

OUTSIDE = 0.01  # share of events outside the range from which it is stated
SIGMAS, PERCENT = 8.0, 3.0  # range of differences in standard errors, and of full charge
COLUMNS = 4  # panels of further parameters in a row
ROC_POINTS = 201  # points per curve
ROC_RANGE = (50, 100)  # percent of the DEP that useful cuts keep


@styled
def cycle_figure(pulses: Mapping[str, FloatArray], dt_ns: float) -> Figure:
    """Pulses through a cycle, a panel for each stage (paper, figures of the cycles).

    Parameters
    ----------
    pulses
        Pulses by stage, shape (n, samples); each row is the same event in all.
    dt_ns
        Sampling period in ns.
    """
    figure, (grid,) = panels((3.4 * len(pulses), 3.2), 1, len(pulses), sharex=True, sharey=True)
    for axes, (title, windows) in zip(grid, pulses.items(), strict=True):
        axes.plot(np.arange(windows.shape[1]) * dt_ns * 1e-3, windows.T, linewidth=0.8)
        axes.set(title=title, xlabel="Time [µs]")
    grid[0].set_ylabel("Normalised charge")
    return figure


@styled
def parameter_histograms(
    values: Mapping[str, Values], axis: Regular, parameter: str, peak: str, comparison: Compared
) -> Figure:
    """Distributions of one parameter at a peak, and differences from the data in sigma.

    For the parameters see `draw_parameter`; `peak` is the name of the gamma line.
    """
    height = 4.0 + LINE * len(values)
    figure, ((axes,), (below,)) = panels((5.6, height), 2, **STACKED)
    draw_parameter(axes, values, axis, parameter, comparison)
    counts = {method: histogram(v, axis)[1:-2] for method, v in values.items()}
    sizes = {method: max(len(v), 1) for method, v in values.items()}
    for method in counts:
        if method != "data":
            share, of_data = (counts[m] / sizes[m] for m in (method, "data"))
            common = (counts[method] + counts["data"]) / (sizes[method] + sizes["data"])
            error = np.sqrt(common * (1 / sizes[method] + 1 / sizes["data"]))
            pull = (share - of_data) / np.where(error > 0, error, np.nan)
            steps(below, pull, axis.edges, method, label(method))
    sigma_panel(below)
    below.set_xlabel(axes.get_xlabel())
    axes.set_xlabel("")
    legend_above(figure, axes, title=peak)
    return figure


def sigma_panel(axes: Axes) -> None:
    """Residuals in standard deviations, linear, with the range in which all is well."""
    axes.axhspan(-2, 2, color=DATA_FILL, zorder=0)
    axes.set(ylabel="Method − data\n[standard errors]", ylim=(-SIGMAS, SIGMAS))


@styled
def overlap_figure(metrics: Metrics) -> Figure:
    """Overlap with the data by quantity and method, and that of data with data as a band.

    Parameters
    ----------
    metrics
        Content of ``metrics.json``; held-out peaks have a panel each.
    """
    peaks = metrics.held_out
    figure, (grid,) = panels((1.2 + 4.2 * len(peaks), 3.6), 1, len(peaks), sharey=True)
    for axes, peak in zip(grid, peaks, strict=True):
        scores = metrics.peaks[peak]
        compared = {n: c for n, c in scores.judged.items() if c.iou.get("ceiling") is not None}
        methods = [m for m in scores.methods if m != "raw"]
        x, every = np.arange(len(compared)), ["ceiling", *methods]
        of = compared.values()
        iou = {m: np.array([c.iou.get(m) for c in of], float) for m in every}
        error = {m: np.array([c.iou_std.get(m) for c in of], float) for m in every}
        half = error["ceiling"]
        axes.bar(x, 2 * half, 0.9, iou["ceiling"] - half, color=DATA_FILL, zorder=0)
        axes.hlines(iou["ceiling"], x - 0.45, x + 0.45, color=COLOURS["data"], lw=1)
        for i, method in enumerate(methods):
            at = x + 0.7 * ((i + 0.5) / len(methods) - 0.5)
            look = {"markersize": 3.5, "lw": 0, "elinewidth": 1, "label": label(method)}
            points(axes, at, iou[method], error[method], method, **look)
        axes.set(title=peak, xticks=range(len(compared)), ylim=(0, 100))
        texts = [QUANTITIES.get(name, name.replace("_", " ")) for name in compared]
        axes.set_xticklabels(texts, rotation=30, ha="right")
    grid[0].set_ylabel("Overlap with the data [%]\n(bands: data vs data)")
    legend_above(figure, grid[0], 4)
    figure.subplots_adjust(bottom=0.2)  # names are longer than numbers
    return figure


@styled
def draw_parameter(
    axes: Axes, values: Mapping[str, Values], axis: Regular, parameter: str, compared: Compared
) -> None:
    """Draw the distributions of one parameter: the data filled, each method as a line.

    All histograms sum to one, with the events outside the range, whose share is in the legend
    with each method's IoU and that of data with data.

    Parameters
    ----------
    axes
        Where to draw.
    values
        Values of the parameter by method, the measured ones under ``"data"``.
    axis
        Binning, see `shape_parameters.data_axis`.
    parameter
        Name of the parameter in `PARAMETERS`.
    compared
        Result of `comparisons.compare` for the parameter.
    """
    for method, of_method in values.items():
        name, kind = ("ceiling", "data vs data") if method == "data" else (method, "IoU")
        score, missing = compared.iou.get(name), int(np.isnan(of_method).sum())
        text = label(method) + ("" if score is None else f" ({kind} {score:.1f} %)")
        text += f", n = {len(of_method)}" + (f", {missing} undefined" if missing else "")
        below, *shares, above, _ = histogram(of_method, axis) / max(len(of_method), 1)
        if below + above >= OUTSIDE:
            text += f", {100 * (below + above):.0f} % outside"
        steps(axes, shares, axis.edges, method, text)
    axes.set(xlabel=LABELLED[parameter].axis_label, ylabel="Fraction of events per bin")


@styled
def further_histograms(
    values: Mapping[str, Mapping[str, Values]], max_bins: int, peak: str
) -> Figure:
    """Distributions of the further parameters, a small panel for each.

    Parameters
    ----------
    values
        Values by parameter and method, the measured ones under ``"data"``; of each parameter
        some measured values are finite.
    max_bins
        Maximum number of bins, see `comparisons.data_axis`.
    peak
        Name of the gamma line, for the title.
    """
    rows, methods = -(-len(values) // COLUMNS), list(next(iter(values.values())))
    figure, grid = panels((10.5, 1.9 * rows + 0.4), rows, COLUMNS, labels=False)
    for axes, (name, by_method) in zip(grid.flat, values.items(), strict=False):
        axis = data_axis(by_method["data"], max_bins)
        for method, of_method in by_method.items():
            share = histogram(of_method, axis)[1:-2] / max(len(of_method), 1)
            steps(axes, share, axis.edges, method, label(method))
        axes.set(xlabel=LABELLED[name].axis_label, yticks=[])
        axes.xaxis.set_major_locator(MaxNLocator(4))
    for empty in grid.flat[len(values) :]:
        empty.set_axis_off()
    title = f"{peak}: further parameters, fraction of events per bin, in the data's range"
    legend_above(figure, grid[0, 0], len(methods), title)
    return figure


@styled
def shape_figure(
    columns: Mapping[str, Mapping[str, MeanPulse]], dt_ns: float, title: str
) -> Figure:
    """Pulses aligned at half maximum (top) and differences from the data (bottom), by column.

    Differences are in standard errors; those of neighbouring samples are correlated.  The
    simulation is scaled to the height of the data, which would dominate the difference.

    Parameters
    ----------
    columns
        Pulses by method in each column, the measured one under ``"data"``; drawn in this
        order, later ones on top.
    dt_ns
        Sampling period in ns.
    title
        Title of the figure.
    """
    methods, n = list(next(iter(columns.values()))), len(columns)
    per_line = len(methods) if n > 1 else 3
    width = 2.0 + 2.7 * n if n > 1 else 5.6
    figure, grid = panels((width, 4.9), 2, n, sharey="row", **STACKED)
    for (above, below), (name, pulses) in zip(grid.T, columns.items(), strict=True):
        data = pulses["data"]
        time_ns = dt_ns * (np.arange(len(data.mean)) - round(BEFORE_NS / dt_ns))
        for method, pulse in pulses.items():
            mean = pulse.mean
            if method == "raw":
                mean = mean * (data.mean[-1] / mean[-1])
            line(above, time_ns, mean, method, label(method))
            if method != "data":
                error = np.hypot(pulse.error, data.error) if data.n > 1 else np.array(0.01)
                pull = (mean - data.mean) / np.where(error > 0, error, np.nan)
                line(below, time_ns, pull, method)
        above.set(title=name, xlim=(time_ns[0], time_ns[-1]))
        below.axhline(0, color="black", linewidth=0.8)
        below.set_xlabel("Time from half maximum [ns]")
        if data.n > 1:
            most = max(pulse.n for method, pulse in pulses.items() if method != "data")
            counts = f"{data.n} measured, {most} simulated pulses"
            above.text(0.97, 0.03, counts, ha="right", transform=above.transAxes, size=8)
            sigma_panel(below)
            below.label_outer()
        else:  # a pulse alone has no error
            below.set(ylabel="Method − data\n[% of full charge]", ylim=(-PERCENT, PERCENT))
    grid[0, 0].set_ylabel("Normalised charge")
    legend_above(figure, grid[0, 0], per_line, title)
    return figure


@styled
def roc_figure(ae: Mapping[str, Mapping[str, Values]]) -> Figure:
    """Survival of other peaks after low-A/E cuts, against the survival of the DEP.

    Parameters
    ----------
    ae
        A/E of single pulses by peak and method, the measured ones under ``"data"``;
        non-finite values are left out.
    """
    others = [peak for peak in ae if peak != DEP]
    methods = [m for m in ae[DEP] if all(m in ae[peak] for peak in others)]
    size = (3.4 * len(others) + 0.6, 3.8)
    figure, (grid,) = panels(size, 1, len(others), sharey=True)
    accepted = np.linspace(0.0, 1.0, ROC_POINTS)
    for axes, peak in zip(grid, others, strict=True):
        for method in sorted(methods, key=lambda name: name == "ren"):
            single, other = (finite_values(ae[name][method]) for name in (DEP, peak))
            if not (single.size and other.size):
                continue
            cuts = np.quantile(single, 1 - accepted)
            left = 1 - np.searchsorted(np.sort(other), cuts) / other.size
            line(axes, 100 * accepted, 100 * left, method, label(method))
        axes.set(xlabel=f"{DEP} that survives [%]", title=peak, xlim=ROC_RANGE)
    # useful cuts leave few multi-site events
    grid[0].set(ylabel="Peak that survives [%]", yscale="log", ylim=(1, 100))
    grid[0].yaxis.set_major_formatter("{x:g}")
    grid[0].yaxis.set_minor_formatter("")
    legend_above(figure, grid[0], 3)
    return figure


@styled
def ae_energy_figure(methods: Mapping[str, Course]) -> Figure:
    """Relative shift and relative width of the single-site peak of A/E against energy.

    Parameters
    ----------
    methods
        ``methods`` of `against_energy`.
    """
    figure, ((above,), (below,)) = panels((6.4, 5.6), 2, **STACKED)
    for method, course in methods.items():
        line, look = course.mean, {"linestyle": "none", "markersize": 3.5}
        energy, mean, error, sigma, sigma_error = columns(course.points)
        shift, scaled = 100 * (mean / course.scale - 1), 100 * error / course.scale
        points(above, energy, shift, scaled, method, **look)
        points(below, energy, 100 * sigma / mean, 100 * sigma_error / mean, method, **look)
        along = np.linspace(energy.min(), energy.max(), 100)
        text = f"{label(method)}: {number(line.per_mev_percent, '+.3f')} ± "
        text += f"{line.per_mev_error_percent:.3f} % per MeV"
        fit = {"color": COLOURS[method], "gid": GROUP + method}
        above.plot(along, 100 * (line.a * along + line.b - 1), label=text, **fit)
        below.plot(along, 100 * course.resolution.of(along), **fit)
    above.set_ylabel(f"A/E over that at {REFERENCE_KEV:g} keV, − 1 [%]")
    below.set(ylabel="Width σ of A/E [%]", xlabel="Energy [keV]")
    above.legend()
    return figure


@styled
def spectrum_of_noise(spectra: Mapping[str, Spectrum], peak: str) -> Figure:
    """Draw the noise power by band and method, and its ratio to that of the data.

    Parameters
    ----------
    spectra
        Result of `baseline_spectra`.
    peak
        Name of the gamma line, for the title.
    """
    figure, ((above,), (below,)) = panels((5.6, 4.4), 2, **STACKED)
    data = np.array(spectra["data"].power)
    drawn = {method: spectrum for method, spectrum in spectra.items() if not spectrum.missing}
    for method, spectrum in drawn.items():
        power, error = np.array(spectrum.power), np.array(spectrum.power_std)
        look = {"markersize": 3, "label": label(method)}
        points(above, spectrum.frequency_mhz, power, error, method, **look)
        if method != "data":
            # bands without noise in the data have no ratio
            usual = np.where(data > 0, data, np.nan)
            points(below, spectrum.frequency_mhz, power / usual, error / usual, method, **look)
    below.axhline(1, color="black", linewidth=0.8)
    scale = "log" if any(any(of.power) for of in drawn.values()) else "linear"
    above.set(title=f"{peak}: noise before the pulse", xscale="log", yscale=scale)
    above.set_ylabel("Mean square per band\n[pulse height²]")
    above.legend()
    for axis in (above.yaxis, below.xaxis):
        axis.set_major_formatter("{x:g}")  # powers as formulas take long to set
        axis.set_minor_formatter("")
    below.set(xlabel="Frequency [MHz]", ylabel="Method / data")
    return figure
