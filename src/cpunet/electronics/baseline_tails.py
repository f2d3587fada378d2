"""Level and tilt of baselines, and the tails of earlier pulses that they indicate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cpunet.electronics.exponentials import FloatArray
from cpunet.errors import CpunetError
from cpunet.pulses.baselines import Baselines

MIN_N = 30  # minimum number of baselines
SIGMA_PER_MAD = 1.4826
MIN_LARGE = 20  # minimum number of large remainders to determine coupling and decay time
# A baseline whose level differs by more than this factor from what its tilt implies is not
# that of a remainder.
COUPLED = 2.5
# Number of Gaussian standard deviations of the residual RMS beyond which a baseline holds
# another pulse.
DISTURBED = 6.0
MIN_SAMPLES = 64  # minimum length of a baseline


class UsableBaselines(NamedTuple):
    """Baselines of one length, in ADC counts, and what is known of their traces."""

    values: FloatArray
    energy_kev: FloatArray
    adc_per_kev: float
    tail_decay_us: float
    dt_ns: float


def usable(baselines: Baselines) -> UsableBaselines:
    """Baselines as tails of earlier pulses are measured from them.

    Raises
    ------
    CpunetError
        If too few traces can be prepared or have a known energy, the baselines are too short,
        or the pulses do not decay.
    """
    prepared, length = baselines.prepared, baselines.length
    if len(prepared) < MIN_N:
        reasons = ", ".join(f"{n} {reason}" for reason, n in prepared.rejections.items())
        raise CpunetError(
            f"only {len(prepared)} of {len(baselines)} traces can be prepared "
            f"({reasons or 'there are no more'}); {MIN_N} or more are needed to tell remains "
            "of earlier pulses"
        )
    if length < MIN_SAMPLES:
        raise CpunetError(
            f"the traces have {length} samples before the pulse; remains of earlier pulses "
            f"need {MIN_SAMPLES} or more, so give traces with a longer baseline"
        )
    with np.errstate(divide="ignore"):  # an energy of 0 is left out
        gains = baselines.height / prepared.pulses.energy_kev
    gains = gains[np.isfinite(gains) & (gains > 0)]
    if len(gains) < MIN_N:
        raise CpunetError(
            f"only {len(gains)} traces have a known energy and can be prepared; {MIN_N} or "
            "more are needed to tell remains of earlier pulses in keV"
        )
    large = prepared.scale >= np.median(prepared.scale)
    slope = float(np.median(prepared.tail_slope[large]))
    if not slope < 0:
        raise CpunetError(
            "the tails of the traces do not decay, so nothing is known of earlier pulses; "
            "are these measured traces?"
        )
    return UsableBaselines(
        baselines.first.waveforms[:, :length].astype(float),
        baselines.first.energy_kev,
        float(np.median(gains)),
        -1e3 / slope,
        baselines.first.dt_ns,
    )


def tail_shape(length: int, dt_ns: float, decay_us: float) -> FloatArray:
    """Decay of a remainder that is 1 at the first sample, shape ``(length,)``."""
    return np.asarray(np.exp(-np.arange(length) * dt_ns * 1e-3 / decay_us), float)


def read_baselines(
    baselines: FloatArray, dt_ns: float, decay_us: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    r"""Mean of each baseline, the remainder from its tilt, and the residual RMS.

    The remainder is the least-squares height :math:`A` of

    .. math:: b_j = c + A e^{-t_j / \tau},

    with a free level :math:`c`. Its height refers to the first sample.

    Parameters
    ----------
    baselines
        First samples of the traces, shape ``(n, samples)``.
    dt_ns
        Sampling period in ns.
    decay_us
        Decay time in us.

    Returns
    -------
    tuple of array
        Mean, remainder and RMS in the units of the baselines, each of shape ``(n,)``.

    Examples
    --------
    >>> tail = 100 + 7 * np.exp(-np.arange(500) * 0.016 / 50)
    >>> _, left, width = read_baselines(tail[np.newaxis], 16.0, 50.0)
    >>> round(float(left[0]), 6), bool(width[0] < 1e-9)
    (7.0, True)
    """
    shape = tail_shape(baselines.shape[1], dt_ns, decay_us)
    lever = shape - shape.mean()
    with np.errstate(invalid="ignore", over="ignore"):
        mean = baselines.mean(axis=1)
        left = baselines @ lever / (lever @ lever)
        width = (baselines - mean[:, np.newaxis] - left[:, np.newaxis] * lever).std(axis=1)
    return mean, left, np.where(np.isfinite(width), width, np.inf)


def widest(width: FloatArray) -> float:
    """RMS beyond which a baseline holds another pulse."""
    finite = width[np.isfinite(width)]
    if len(finite) < MIN_N:
        raise CpunetError(f"only {len(finite)} traces have finite baselines; give more")
    centre = float(np.median(finite))
    sigma = SIGMA_PER_MAD * float(np.median(np.abs(finite - centre)))
    return centre + max(DISTURBED * sigma, 0.1 * centre)


def mode(values: FloatArray) -> float:
    """Mode of a one-sided distribution, by repeatedly halving the shortest half."""
    ordered = np.sort(values)
    while len(ordered) > 8:
        half = len(ordered) // 2
        first = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
        ordered = ordered[first : first + half + 1]
        if ordered[-1] == ordered[0]:
            break
    return float(ordered.mean())


def lower_spread(values: FloatArray) -> float:
    """Standard deviation of the side below 0, which remainders do not affect."""
    below = -values[values <= 0]
    return max(float(SIGMA_PER_MAD * np.median(below)) if len(below) else 0.0, 1e-9)


def lifted(above: FloatArray, left: FloatArray) -> bool:
    """Whether tilted baselines are as high as their tilt implies, as with DC coupling."""
    if len(above) < MIN_LARGE:
        return False
    ratio = float(np.median(above[:, : above.shape[1] // 4].mean(axis=1) / left))
    return 1 / COUPLED < ratio < COUPLED


def own_decay_us(above: FloatArray, dt_ns: float) -> tuple[float, float] | None:
    """Decay time from the two halves of tilted baselines, and its error, in us."""
    half = above.shape[1] // 2
    first, second = above[:, :half].mean(axis=1), above[:, half : 2 * half].mean(axis=1)
    whole = (first > 0) & (second > 0)
    fall = np.log(first[whole] / second[whole])
    middle = float(np.median(fall)) if whole.sum() >= MIN_LARGE else 0.0
    if not middle > 0:
        return None
    error = 1.2533 * SIGMA_PER_MAD * float(np.median(np.abs(fall - middle)))
    decay = half * dt_ns * 1e-3 / middle
    return decay, decay * error / middle / float(np.sqrt(len(fall)))
