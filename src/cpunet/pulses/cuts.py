"""Quality cuts that remove pile-up, decaying baselines and outliers (paper, section 3.3).

Each window is the median plus or minus a number of robust standard deviations
(1.4826 MAD) of the set itself, so that no detector-specific constant enters.

The noise in ADC counts is the same for all pulses of a channel, so the error of a slope
of a normalised pulse scales as 1/amplitude.  Slopes are therefore compared as they
would be at the set's median amplitude, and one window serves all energies.
Chi-square is compared as if every pulse had the median noise.  Otherwise a pulse that
extends into its own baseline window would hide its bad fit behind a large "noise".
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.preparation import FloatColumn, Prepared, Rejection
from cpunet.recipes.schema import CutConfig
from cpunet.settings import Config

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
        Measured pulses of one channel.  Pulses of several energies must have been prepared
        from raw traces: if they were scaled before, their different noise is hidden.
    config
        Half-widths in robust standard deviations.

    Returns
    -------
    CutWindows
        Windows for ``tail_slope``, ``chi2`` (upper bound only), ``baseline`` and
        ``baseline_slope``; none with fewer than ten pulses.

    Raises
    ------
    CpunetError
        If the set is empty.
    """
    if not len(prepared):
        raise CpunetError("no pulses to draw quality cuts from; select more energies or files")
    amplitude = float(np.median(prepared.scale))
    noise = float(np.median(prepared.baseline_rms * prepared.scale))
    sigmas = {
        "tail_slope": config.decay_sigmas,
        "chi2": config.chi2_sigmas,
        "baseline": config.baseline_sigmas,
        "baseline_slope": config.baseline_sigmas,
    }
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


def compared(prepared: Prepared, cuts: CutWindows, window: CutWindow) -> FloatColumn:
    """Value of each pulse in the form that `window` bounds, for cuts and figures."""
    values, weights = _values(prepared, window.name, cuts.amplitude, cuts.noise)
    return window.centre + (values - window.centre) * weights


def apply_cuts(prepared: Prepared, cuts: CutWindows) -> Prepared:
    """Drop the pulses outside any window and count each under the first one it fails.

    An undefined value (chi-square without noise) fails no window.
    """
    reasons: npt.NDArray[np.uint8] = np.zeros(len(prepared), np.uint8)
    for window in cuts.windows:
        values = compared(prepared, cuts, window)
        outside = np.zeros(len(prepared), bool)
        if window.low is not None:
            outside |= values < window.low
        if window.high is not None:
            outside |= values > window.high
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
