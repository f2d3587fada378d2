"""From raw traces to the aligned, normalised windows that a network sees, and quality cuts.

The definition follows the paper (Bhimani et al. 2026, section 3.3).  Measured traces
are aligned, baseline-subtracted and scaled to a fixed level of their last samples.  Simulated
pulses are aligned in the same way and scaled to 0…1.

The paper aligns at 99.9 % of the maximum.  On a flat, noisy top that is wherever noise peaks:
at 200 keV a fifth of the windows begin inside the pulse.  Half of the height is where a pulse
is steep.  The height is that of a straight line through the tail, continued to the alignment:
hundreds of samples average the noise, and a decay takes nothing from it.  A search in a trace
averaged over half a microsecond decides which of several crossings is meant; its time is
interpolated in the trace itself.
Nothing is skipped silently: each trace gets a `Rejection`.

Quality cuts remove pile-up, decaying baselines and outliers (same section).  Each cut window is
the median plus or minus a number of robust standard deviations (1.4826 MAD) of the set itself,
so that no detector-specific constant enters.

The noise in ADC counts is the same for all pulses of a channel, so the error of a slope
of a normalised pulse scales as 1/amplitude.  Slopes are therefore compared as they
would be at the set's median amplitude, and one window serves all energies.
Chi-square is compared as if every pulse had the median noise.  Otherwise a pulse that
extends into its own baseline window would hide its bad fit behind a large "noise".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses import _kernels
from cpunet.pulses._kernels import Rejection as Rejection
from cpunet.pulses.container import Pulses, Rows, Which
from cpunet.recipes.schema import CutConfig, PreparationConfig
from cpunet.settings import Config

Kind = Literal["simulated", "measured"]
FloatColumn = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint8]


def rejections_of(codes: Codes) -> dict[str, int]:
    """Number of rejected pulses by reason, for the reasons that occurred."""
    counts = np.bincount(codes).tolist()
    return {Rejection(code).label: n for code, n in enumerate(counts) if code and n}


@dataclass(frozen=True, eq=False)
class Prepared:
    """Prepared pulses, how each was prepared, and why others were rejected.

    ``pulses.waveforms = (raw - baseline) / scale``, one row per accepted pulse.

    Parameters
    ----------
    pulses
        Accepted pulses, windows of shape ``(n, samples_before + samples_after)``.
    index
        Row of each pulse among all that were read, as of `codes`.
    baseline, scale
        Baseline and scale of the raw trace, in its units.
    align_sample
        Sample of the raw trace that became sample ``samples_before``.
    baseline_rms
        RMS about a straight line of the last ``baseline_samples`` of the raw trace before
        the pulse begins, divided by `scale`.
    baseline_slope
        Slope of that line divided by `scale`, in 1/ms.
    tail_slope
        Slope of the logarithm of the tail, in 1/ms; negative for a decay.
    chi2
        Reduced chi-square of that fit, with `baseline_rms` as the error of each
        sample; NaN for pulses without noise.
    codes
        `Rejection` code of every row read, accepted or not.
    """

    pulses: Pulses
    index: Rows
    baseline: FloatColumn
    scale: FloatColumn
    align_sample: npt.NDArray[np.int64]
    baseline_rms: FloatColumn
    baseline_slope: FloatColumn
    tail_slope: FloatColumn
    chi2: FloatColumn
    codes: Codes

    def __len__(self) -> int:
        return len(self.pulses)

    @property
    def n_read(self) -> int:
        """Number of pulses read, accepted or not."""
        return len(self.codes)

    @property
    def rejections(self) -> dict[str, int]:
        """Number of rejected pulses by reason, for the reasons that occurred."""
        return rejections_of(self.codes)

    def __getitem__(self, which: Which) -> Prepared:
        """The pulses selected by a slice, a mask or row numbers.

        Pulses left out this way are not rejected: `codes` and the counts still describe
        everything read.
        """
        columns = {name: getattr(self, name)[which] for name in _PER_PULSE}
        return replace(self, **columns)

    def rejected(self, reasons: Codes) -> Prepared:
        """Reject the pulses whose code is not ``Rejection.ACCEPTED``, and count them.

        Parameters
        ----------
        reasons
            One `Rejection` for each pulse.
        """
        if not reasons.any():
            return self
        codes = self.codes.copy()
        codes[self.index] = reasons
        return replace(self[reasons == Rejection.ACCEPTED], codes=codes)

    @classmethod
    def concatenate(cls, sets: Sequence[Prepared]) -> Prepared:
        """Concatenate sets in the order in which they were read.

        Row numbers continue from set to set.  For consecutive blocks of a file they
        remain the rows of that file; for several files they are rows of the sequence.

        Raises
        ------
        CpunetError
            If lengths or sampling periods differ.
        """
        pulses = Pulses.concatenate([s.pulses for s in sets])
        starts = np.cumsum([0, *(s.n_read for s in sets[:-1])])
        index = [s.index + start for s, start in zip(sets, starts, strict=True)]
        names = (*_PER_PULSE[2:], "codes")  # the first two are joined already
        joined = {name: np.concatenate([getattr(s, name) for s in sets]) for name in names}
        return cls(pulses, np.concatenate(index), **joined)


_PER_PULSE = tuple(f.name for f in fields(Prepared) if f.name != "codes")


def prepare(pulses: Pulses, config: PreparationConfig, kind: Kind) -> Prepared:
    """Align, cut out and normalise every pulse (paper, section 3.3).

    The window is placed so that its sample ``samples_before`` is the one nearest to the
    crossing of half the height, or the first one after the last sample below a fraction of the
    maximum, see `PreparationConfig`.  From a *measured* window the mean
    of its first ``baseline_samples`` is subtracted, and it is scaled so that its last
    ``tail_samples`` average ``tail_level``.  A *simulated* window is scaled so that its
    lowest and highest values are 0 and 1.  The window is padded with 0 before the record and
    with the record's last value after it; measured windows that need more padding than the
    settings allow are rejected.  Preparing prepared pulses changes nothing.

    Parameters
    ----------
    pulses
        Raw traces of any length, in any units.
    config
        Preparation settings.
    kind
        Normalisation: ``"measured"`` or ``"simulated"``.

    Returns
    -------
    Prepared
        Accepted pulses; ``codes`` holds the outcome of every input pulse.

    Raises
    ------
    CpunetError
        If the traces have no samples.

    Examples
    --------
    >>> from cpunet.recipes.schema import PreparationConfig
    >>> config = PreparationConfig(
    ...     before_ns=64, after_ns=64, align_at=0.999, baseline_ns=32, tail_ns=16,
    ...     tail_level=0.8, decay_fit_ns=48, padding_before_ns=0, padding_after_ns=0,
    ...     saturation_run=4)
    >>> raw = Pulses.of([[0, 0.5, 2, 2, 2], [1, 1, 1, 1, 1]], dt_ns=16)
    >>> prepared = prepare(raw, config, "simulated")
    >>> prepared.pulses.waveforms.tolist()
    [[0.0, 0.0, 0.0, 0.25, 1.0, 1.0, 1.0, 1.0]]
    >>> prepared.rejections
    {'constant': 1}
    """
    if pulses.length == 0:
        raise CpunetError("the pulses have no samples; give traces of at least one sample")
    config = config.at(pulses.dt_ns)
    settings = _kernels.Settings(
        simulated=kind == "simulated",
        of_maximum=0.0 if config.align_at == "half_height" else config.align_at,
        max_padding_before=config.samples(config.padding_before_ns),
        max_padding_after=config.samples(config.padding_after_ns),
        smoothed=config.samples(0.5 * _kernels.SMOOTHED_NS),
        begun_margin=config.samples(_kernels.BEGUN_MARGIN_NS),
        prepared=config.samples(_kernels.PREPARED_NS),
        **{n: getattr(config, n) for n in _kernels.Settings._fields if hasattr(config, n)},
    )
    n, length = len(pulses), config.length
    windows, codes = np.empty((n, length), np.float32), np.empty(n, np.uint8)
    numbers, traces = np.empty((n, len(_kernels.NUMBERS))), pulses.waveforms
    n = _kernels.prepare_block(np.ascontiguousarray(traces), settings, windows, numbers, codes)
    windows.resize((n, length), refcheck=False)  # releases the other rows without a copy
    columns = dict(zip(_kernels.NUMBERS, numbers[:n].T.copy(), strict=True))
    align_sample = columns.pop("align_sample").astype(np.int64)
    for name in ("baseline_slope", "tail_slope"):
        columns[name] *= 1e6 / pulses.dt_ns  # per ms
    rows = np.flatnonzero(codes == Rejection.ACCEPTED)
    events = pulses.with_waveforms(traces[:, :0])[rows]
    t0_ns = events.t0_ns + (align_sample - config.samples_before) * pulses.dt_ns
    events = replace(events, waveforms=windows, t0_ns=t0_ns)
    return Prepared(events, rows, codes=codes, align_sample=align_sample, **columns)


# With fewer pulses the MAD is meaningless and no window is set.
_MIN_PULSES = 10
_SIGMA_PER_MAD = 1.4826
_FLOAT32_ROUNDING = 2.0**-23


class CutWindow(Config):
    """One accepted interval; a bound of None means no bound.

    ``tail_slope`` and ``baseline_slope`` are in 1/ms at the median amplitude,
    ``baseline`` is in units of the raw trace, and ``chi2`` is dimensionless.
    """

    name: str
    centre: float
    low: float | None
    high: float | None


class CutWindows(Config):
    """The windows of a set, with the amplitude and noise at which pulses are compared.

    Parameters
    ----------
    amplitude, noise
        Median scale and median baseline RMS of the set, in units of the raw trace.
    windows
        Windows in the order in which they are applied.
    """

    amplitude: float
    noise: float
    windows: tuple[CutWindow, ...]


def fit_cuts(prepared: Prepared, config: CutConfig) -> CutWindows:
    """Derive the windows from the medians and MADs of the set.

    Parameters
    ----------
    prepared
        Measured pulses of one channel, at least one.  Pulses of several energies must have been
        prepared from raw traces: if they were scaled before, their different noise is hidden.
    config
        Half-widths in robust standard deviations.

    Returns
    -------
    CutWindows
        Windows for ``tail_slope``, ``chi2`` (upper bound only), ``baseline`` and
        ``baseline_slope``; none with fewer than ten pulses.
    """
    amplitude = float(np.median(prepared.scale))
    noise = float(np.median(prepared.baseline_rms * prepared.scale))
    sigmas = {"tail_slope": config.decay_sigmas, "chi2": config.chi2_sigmas}
    sigmas |= dict.fromkeys(("baseline", "baseline_slope"), config.baseline_sigmas)
    windows = []
    for name, k in sigmas.items():
        values, weights = _values(prepared, name, amplitude, noise)
        finite = np.isfinite(values)
        if finite.sum() < _MIN_PULSES:
            continue
        centre = float(np.median(values[finite]))
        deviations = np.abs((values - centre) * weights)[finite]
        # A baseline within the noise of one sample is not an outlier.
        floor = noise if name == "baseline" else 0.0
        rounding = _FLOAT32_ROUNDING * float(np.median(np.abs(values[finite])))
        sigma = max(_SIGMA_PER_MAD * float(np.median(deviations)), floor, rounding)
        low = None if name == "chi2" else centre - k * sigma
        windows.append(CutWindow(name=name, centre=centre, low=low, high=centre + k * sigma))
    return CutWindows(amplitude=amplitude, noise=noise, windows=tuple(windows))


def apply_cuts(prepared: Prepared, cuts: CutWindows) -> Prepared:
    """Drop the pulses outside any window and count each under the first one it fails.

    An undefined value (chi-square without noise) fails no window.
    """
    reasons: npt.NDArray[np.uint8] = np.zeros(len(prepared), np.uint8)
    for window in cuts.windows:
        values, weights = _values(prepared, window.name, cuts.amplitude, cuts.noise)
        values = window.centre + (values - window.centre) * weights
        low = -np.inf if window.low is None else window.low
        high = np.inf if window.high is None else window.high
        outside = (values < low) | (values > high)
        reasons[outside & (reasons == Rejection.ACCEPTED)] = Rejection[window.name.upper()]
    return prepared.rejected(reasons)


def _values(
    prepared: Prepared, name: str, amplitude: float, noise: float
) -> tuple[FloatColumn, FloatColumn]:
    """A parameter, and the weight of each pulse's deviation from the median."""
    values: FloatColumn = getattr(prepared, name)
    if name in ("tail_slope", "baseline_slope"):
        return values, prepared.scale / amplitude
    if name == "chi2":
        rms = prepared.baseline_rms * prepared.scale
        values = values * (rms / noise) ** 2 if noise > 0 else np.full_like(values, np.nan)
    return values, np.ones_like(values)
