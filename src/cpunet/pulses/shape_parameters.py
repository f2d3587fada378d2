"""Further pulse-shape parameters: times, current, noise; and bins of a parameter.

`cpunet.pulses.parameters` defines the three parameters by which a translation is
evaluated.  This module adds others on which an analysis may cut.

Times and late charge as LEGEND computes them: pole-zero corrected, by dspeed's processors.

The decay is the median one of the pulses themselves, as an analysis takes it from the tails of
a channel; pulses that do not decay are not corrected.  The height is that of a trapezoid.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import hist
import numpy as np
from hist.axis import Regular

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses, blocks
from cpunet.pulses.parameters import (
    BLOCK,
    PARAMETERS,
    Parameter,
    Values,
    crossings,
    current_amplitude,
    drift_time,
    tail_slope,
)
from cpunet.recipes.schema import PreparationConfig, ScoreConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# Rise and flat top of the trapezoid, and times over which charge is compared with that later.
TRAP_NS, LATE_NS, EFFECTIVE_NS = 2000.0, 2000.0, 3000.0
T0_RISE_NS, T0_FALL_NS = 128.0, 2000.0  # of the filter that finds the begin of a pulse
SILENT = 1e-4  # heights: noise of pulses without any
FRACTIONS = {"tp_99": 0.99, "tp_90": 0.9, "tp_80": 0.8, "tp_50": 0.5, "tp_10": 0.1}


def legend_parameters(
    waveforms: FloatArray, decay_ns: float, noise: Values, dt_ns: float, aligned: int
) -> dict[str, Values]:
    r"""Times in ns from the aligned sample, and areas over the height in ns.

    With the corrected pulse :math:`w` of height :math:`E` (`docs/parameters.md`),

    .. math:: \mathrm{LQ} = \frac{1}{E} \int_{t_{80}}^{t_{80} + 2\,\mu s}
        [w(t + 2\,\mu s) - w(t)] \, dt

    and the effective drift time is the same from :math:`t_0`, over 3 µs.

    Parameters
    ----------
    waveforms
        Prepared pulses, shape (n, samples).
    decay_ns
        Time constant of their tails; infinite if they do not decay.
    noise
        RMS of each baseline in pulse heights, shape (n,).
    dt_ns
        Sampling period in ns.
    aligned
        Sample from which times count.
    """
    from dspeed.processors.pole_zero import pole_zero
    from dspeed.processors.trap_filters import trap_norm, trap_pickoff
    from scipy.signal import fftconvolve  # half of SciPy

    corrected = np.asarray(waveforms, float)
    if np.isfinite(decay_ns):
        corrected = pole_zero(corrected, decay_ns / dt_ns)
    half = round(TRAP_NS / dt_ns)
    trapezoid = np.empty_like(corrected)
    trap_norm(corrected, half, half, trapezoid)
    height, top = trapezoid.max(axis=1), corrected.argmax(axis=1)

    times: dict[str, Values] = {}
    last: Values = top.astype(float)
    for name, fraction in FRACTIONS.items():
        begin = np.ceil(np.nan_to_num(last)).astype(int)
        times[name] = last = crossings(corrected, fraction * height, begin)
    # behind dspeed's ``t0_filter``: the mean just now minus that before
    rise, fall = round(T0_RISE_NS / dt_ns), round(T0_FALL_NS / dt_ns)
    ramp = 2 * np.arange(rise, 0, -1) / (rise * (rise + 1))
    weights = np.concatenate([ramp, np.full(fall, -1 / fall)])
    filtered = fftconvolve(corrected, weights[np.newaxis], axes=1)[:, : corrected.shape[1]]
    filtered[:, : len(weights)] = 0.0  # which needs samples before the record
    times["tp_0_est"] = crossings(filtered, np.maximum(noise, SILENT), filtered.argmax(axis=1))

    areas, begins = {}, {"lq": times.pop("tp_80"), "dt_eff": times["tp_0_est"]}
    for (name, begin), over_ns in zip(begins.items(), (LATE_NS, EFFECTIVE_NS), strict=True):
        n = round(over_ns / dt_ns)
        areas[name] = over_ns * trap_pickoff(corrected, n, 0, begin + 2 * n) / height
    times = {name: (time - aligned) * dt_ns for name, time in times.items()}
    times["rise_time"] = times["tp_90"] - times.pop("tp_10")
    return times | areas


# Fractions of the maximum at which a pulse is timed.
TIME_POINTS = {"t01": 0.01, "t10": 0.1, "t50": 0.5, "t90": 0.9, "t99": 0.99}
# Rise times: the time points at which they begin and end.
_RISES = ("10_90", "01_90", "01_99", "10_99", "90_99")
RISE_TIMES = {f"rise_{name}": tuple(f"t{end}" for end in name.split("_")) for name in _RISES}


# Definitions and sources are in docs/parameters.md.
SHAPE_PARAMETERS: dict[str, Parameter] = {
    "current_amplitude": PARAMETERS["current_amplitude"],
    "drift_time": PARAMETERS["drift_time"],
    **{name: Parameter(f"t({100 * f:g} %)", "ns") for name, f in TIME_POINTS.items()},
    **{
        f"rise_{ends}": Parameter(f"Rise time {ends.lstrip('0').replace('_', '–')} %", "ns")
        for ends in _RISES
    },
    **{name: Parameter(name, "ns") for name in ("tp_0_est", "tp_50", "tp_90", "tp_99")},
    "rise_time": Parameter("T(10–90 %)", "ns"),
    "dt_eff": Parameter("Effective drift time dt_eff", "ns"),
    "lq": Parameter("Late charge LQ", "ns"),
    "tail_slope": PARAMETERS["tail_slope"],
    "baseline_rms": Parameter("Baseline RMS", "pulse height"),
}


# What also needs the pulses of another peak, see `cpunet.validation.peaks`.
A_OVER_E = "a_over_e"
LABELLED = SHAPE_PARAMETERS | {A_OVER_E: Parameter("A/E (double escape at 1)", "")}


def all_parameters(
    pulses: Pulses,
    preparation: PreparationConfig,
    scores: ScoreConfig,
    *,
    amplitudes: Values | None = None,
    decay_ns: float | None = None,
) -> dict[str, Values]:
    """All parameters of `SHAPE_PARAMETERS`, each an array with one value per pulse.

    Parameters
    ----------
    pulses
        Prepared pulses.
    preparation
        Preparation settings, with the alignment and the samples of baseline and tail.
    scores
        Score settings, with the fraction of the maximum at which the drift time begins.
    amplitudes
        Current amplitudes of the pulses; computed by default.
    decay_ns
        Decay that LEGEND's parameters are corrected for; by default the median one of these
        pulses.

    Returns
    -------
    dict
        Float64 arrays of shape ``(n,)`` in the units and the order of `SHAPE_PARAMETERS`.
        NaN where a pulse has a non-finite sample or the parameter is undefined.

    Raises
    ------
    CpunetError
        If the pulses do not have the length of the preparation, or too few samples.

    Examples
    --------
    >>> import numpy as np
    >>> from cpunet.recipes import load_recipe
    >>> recipe = load_recipe("paper")
    >>> ramp = np.clip((np.arange(800) - 300) / 100, 0, 1)[np.newaxis]
    >>> values = all_parameters(Pulses.of(ramp, dt_ns=16), recipe.preparation, recipe.scores)
    >>> values["rise_10_90"].round(3), values["dt_eff"].round(1)  # 800 less part of a sample
    (array([1280.]), array([789.2]))
    """
    dt_ns, preparation = pulses.dt_ns, preparation.at(pulses.dt_ns)
    if pulses.length != preparation.length:
        text = f"the pulses have {pulses.length} samples and prepared ones {preparation.length}"
        raise CpunetError(text, "prepare them first")
    values = {name: np.full(len(pulses), np.nan) for name in SHAPE_PARAMETERS}
    if decay_ns is None:
        finite = np.isfinite(pulses.waveforms).all(axis=1)
        slopes = tail_slope(pulses.waveforms[finite], dt_ns, preparation.decay_fit_samples)
        decay_ns = median_decay_ns(slopes)
    n, aligned = preparation.baseline_samples, preparation.samples_before
    lever = np.arange(n) - (n - 1) / 2
    for rows in blocks(len(pulses), BLOCK):
        good = rows.start + np.flatnonzero(np.isfinite(pulses.waveforms[rows]).all(axis=1))
        block = np.array(pulses.waveforms[good], dtype=np.float32, order="C")
        # overflows become NaN below
        with np.errstate(all="ignore"):
            own = current_amplitude(block, dt_ns) if amplitudes is None else amplitudes[good]
            columns = {
                "current_amplitude": own,
                "drift_time": drift_time(block, dt_ns, scores.drift_start_fraction),
                "tail_slope": tail_slope(block, dt_ns, preparation.decay_fit_samples),
            }
            baselines = block[:, :n].astype(float)
            baselines -= baselines.mean(axis=1, keepdims=True)
            baselines -= np.outer(baselines @ lever / (lever @ lever), lever)  # about a line
            columns["baseline_rms"] = np.sqrt((baselines**2).sum(axis=1) / (n - 2))
            height, levels = block.max(axis=1), np.array([*TIME_POINTS.values()])
            levels = np.outer(np.where(height > 0, height, np.nan), levels).astype(np.float32)
            top = block.argmax(axis=1)[:, np.newaxis]
            samples = crossings(block[:, np.newaxis].astype(float), levels.astype(float), top)
            columns |= dict(zip(TIME_POINTS, (samples.T - aligned) * dt_ns, strict=True))
            for name, (begin, end) in RISE_TIMES.items():
                columns[name] = columns[end] - columns[begin]
        columns = {name: np.where(np.isfinite(c), c, np.nan) for name, c in columns.items()}
        columns |= legend_parameters(block, decay_ns, columns["baseline_rms"], dt_ns, aligned)
        for name, column in columns.items():
            values[name][good] = column
    return values


def median_decay_ns(slopes: Values) -> float:
    """Time constant of the median tail slope (1/ms); infinite if it does not fall."""
    finite = slopes[np.isfinite(slopes)]
    slope = float(np.median(finite)) if finite.size else 0.0
    return -1e6 / slope if slope < 0 else np.inf


MAX_BINS = 49
# Tukey's far-out fence: wide enough for both peaks of an escape line's I_max, and
# unaffected as long as less than a quarter of the events are outliers.
FENCE = 3.0


def data_axis(data: Values, max_bins: int) -> Regular:
    r"""Binning of a parameter from its measured values alone.

    The axis spans the data within three interquartile ranges (IQR) of the quartiles, with
    bins of the Freedman–Diaconis width

    .. math:: w = 2 \, \mathrm{IQR} / \sqrt[3]{n}

    Values outside are counted in the underflow and overflow bins.

    Parameters
    ----------
    data
        Measured values of one parameter; non-finite values are ignored.
    max_bins
        Maximum number of bins (49 in the paper).

    Raises
    ------
    CpunetError
        If no value is finite.

    Examples
    --------
    >>> import numpy as np
    >>> axis = data_axis(np.r_[np.linspace(0, 1, 1000), 1e9], max_bins=49)
    >>> axis.size, axis.edges[[0, -1]].round(3)
    (23, array([0.   , 2.252]))
    """
    finite = data[np.isfinite(data)]
    if finite.size == 0:
        raise CpunetError("the data have no finite value to bin; check the peak's selection")
    lower, upper = np.quantile(finite, [0.25, 0.75])
    if (spread := upper - lower) > 0:
        low = max(finite.min(), lower - FENCE * spread)
        high = min(finite.max(), upper + FENCE * spread)
        width = 2 * spread / np.cbrt(finite.size)
        bins = int(np.clip(np.ceil((high - low) / width), 1, max_bins))
    else:
        # Half of the values are equal: one bin contains them, the others are outside.
        half_width = 1e-3 * max(abs(lower), 1.0)
        low, high, bins = lower - half_width, upper + half_width, 1
    # The last edge is exclusive, but a maximum inside the fence is not an overflow: after
    # rounding, (maximum - low) / (last edge - low) must be less than 1.
    margin = 4 * np.spacing(max(abs(low), abs(high)))
    return Regular(bins, low, high + margin)


def labelled(axis: Regular, parameter: str, bins: int | None = None) -> Regular:
    """The same range, in so many bins if given, with the parameter's name and label.

    Raises
    ------
    CpunetError
        If there are no so many bins.
    """
    if bins is not None and bins < 1:
        raise CpunetError(f"`bins` is {bins}", "give 1 or more")
    low, *_, high = axis.edges
    label = LABELLED[parameter].axis_label
    return Regular(bins or axis.size, low, high, name=parameter, label=label)


class Histogram(hist.Hist[Any], family=hist):
    """A `hist.Hist` that is drawn without further packages."""

    def plot(self, ax: Axes | None = None, **how: Any) -> Axes:  # type: ignore[override]
        """Draw the counts of one axis, of each category of an axis before it.

        Parameters
        ----------
        ax
            Where to draw; a new figure of pyplot by default.
        how
            Further arguments of `matplotlib.axes.Axes.stairs`.
        """
        from cpunet.plotting import label, own_axes

        *categories, axis = self.axes
        ax = own_axes(ax)
        names = list(categories[0]) if categories else []
        for name in names or [None]:
            counts: Any = self if name is None else self[name, :]
            text = {} if name is None else {"label": label(name)}
            ax.stairs(counts.values(), axis.edges, **text | how)
        ax.set(xlabel=axis.label, ylabel="Counts")
        if names:
            ax.legend()
        return ax
