"""Signs that pulses are not what they are given as.

These are wrong polarity, counts that roll over, energies of other events, and a second rate.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.reading.source import amplitude

log = logging.getLogger(__name__)

Values = npt.NDArray[np.float64]

LOW_KEV = 300.0  # at lower energies, noise can be a good part of an amplitude
MIN_PULSES = 30
# Relative deviation from the common gain of what does not go together, and share of pulses up
# to which amplitudes may differ as much and yet be all alike.
FAR, ALIKE = 0.1, 0.1
# Share of pulses whose amplitude and energy do not go together, from which they are refused,
# and from which a warning says so.
MAX_MISMATCHED, FEW_MISMATCHED = 0.2, 0.1
# Samples over which noise is averaged, least part of the tail on either side of a change of
# rate, and least factors by which noise and slope change there.
SMOOTHED, MARGIN, MIN_NOISE, MIN_SLOPE = 64, 0.1, 1.2, 1.5
# Counts that roll over: least period and number of traces, and share of the steep ones;
# share of traces from which all are refused.
LEAST_PERIOD, MIN_ROLLED, MOSTLY, MAX_ROLLED = 256, 3, 0.9, 0.2


class RolledOver(NamedTuple):
    """Counts that jump by a period: the share of such traces, a text, and what to do."""

    share: float
    text: str
    remedy: str

    def __str__(self) -> str:
        return self.text


def rolled_over(traces: FloatArray) -> RolledOver | None:
    """Find counts that jump by a power of two, where nothing else rises within a sample.

    Parameters
    ----------
    traces
        Raw traces, shape (pulses, samples).

    Examples
    --------
    >>> ramp = 30_000 + 50.0 * np.arange(200) + np.arange(5)[:, np.newaxis]
    >>> rolled_over(ramp) is None, str(rolled_over((ramp + 2**15) % 2**16))[:43]
    (True, '100 % of the traces jump by 65536 = 2^16 co')
    """
    jumps = np.abs(np.diff(traces, axis=1)).max(axis=1)
    steep = (jumps > np.ptp(traces, axis=1) / 2) & (jumps >= LEAST_PERIOD / 2)
    if steep.sum() < MIN_ROLLED or (traces[steep] != np.round(traces[steep])).any():
        return None
    period = 2 ** int(np.round(np.log2(np.median(jumps[steep]))))
    left = np.abs(np.diff(np.unwrap(traces[steep], period=period), axis=1)).max(axis=1)
    rolled = (np.abs(jumps[steep] - period) < period / 4) & (left < period / 4)
    if rolled.mean() <= MOSTLY:
        return None
    share, because, view = float(steep.mean()), "", ""
    if period == 2**16 and traces[steep].min() < 0:
        because = "unsigned samples stored as signed, or "
        view = "as unsigned (values.view('uint16') in NumPy), or "
    return RolledOver(
        share,
        f"{100 * share:.0f} % of the traces jump by {period} = 2^{period.bit_length() - 1} "
        f"counts: {because}counts beyond the range rolled over",
        f"write them {view}as numpy.unwrap(values.astype(float), period={period})",
    )


def mismatched(kev: Values, amplitudes: Values) -> float:
    """Fraction of the pulses whose amplitude does not go with their energy.

    Of a detector and its readout, amplitudes are energies times a gain, but for a few percent
    by trapping, for piled-up and for saturated pulses.  Returns 0 if there are too few, or if
    all amplitudes are alike, as of pulses that were scaled to one height.
    """
    with np.errstate(invalid="ignore"):
        usable = (kev > LOW_KEV) & (amplitudes > 0)
    if usable.sum() < MIN_PULSES:
        return 0.0
    heights = amplitudes[usable]
    of_heights, of_gains = (
        float(np.mean(np.abs(values / np.median(values) - 1) > FAR))
        for values in (heights, heights / kev[usable])
    )
    return of_gains if of_heights >= ALIKE else 0.0


def second_rate(traces: FloatArray) -> tuple[int, float] | None:
    """Find where digitisers begin to average samples, which are then longer.

    Averages of m samples have less noise, by the root of m if it is white, and the decay goes
    on m times as fast from sample to sample.

    Parameters
    ----------
    traces
        Raw traces, shape (pulses, samples).

    Returns
    -------
    tuple or None
        The sample at which they begin, and how many they average.
    """
    heights = amplitude(traces)
    good = np.isfinite(heights) & (heights > 0)
    if good.sum() < MIN_PULSES:
        return None
    heights = heights[good]
    start = int(np.median(traces[good].argmax(axis=1))) + SMOOTHED
    tail: Values = traces[good, start:].astype(np.float64)
    n = tail.shape[1]
    margin = max(2 * SMOOTHED, round(MARGIN * n))
    if n < 3 * margin:
        return None
    curvature = np.diff(tail, 2, axis=1)
    noise = np.log(np.median(np.abs(curvature), axis=0) + 1e-9)  # (samples,)
    places = np.arange(margin, n - margin)
    sums = np.concatenate([[0.0], np.cumsum(noise)])
    left = sums[places] / places
    right = (sums[-1] - sums[places]) / (len(noise) - places)
    gain = (left - right) ** 2 * places * (len(noise) - places)
    at = int(places[gain.argmax()])
    lower = float(np.exp(left[gain.argmax()] - right[gain.argmax()]))
    baselines = traces[good].max(axis=1) - heights
    level = np.median((tail - baselines[:, np.newaxis]) / heights[:, np.newaxis], axis=0)
    slopes = [
        np.polyfit(np.arange(len(part)), np.log(np.maximum(part, 1e-3)), 1)[0]
        for part in (level[:at], level[at:])
    ]
    faster = slopes[1] / slopes[0] if slopes[0] < 0 else 0.0
    if lower < MIN_NOISE or faster < MIN_SLOPE:
        return None
    return start + at + 1, float(faster)


def require_sense(path: Path, traces: FloatArray, kev: Values, amplitudes: Values) -> None:
    """Refuse counts that roll over, and energies of other pulses; warn of a second rate.

    Parameters
    ----------
    path
        The file.
    traces
        Its first traces, shape (pulses, samples).
    kev, amplitudes
        Energies and amplitudes of all pulses.
    """
    if (rolled := rolled_over(traces)) is not None:
        error = CpunetError(f"{path}: {rolled}", rolled.remedy)
        if rolled.share >= MAX_ROLLED:
            raise error
        log.warning(str(error))
    share = mismatched(kev, amplitudes)
    text = f"{path}: {100 * share:.0f} % of amplitudes and energies do not go together"
    if share > MAX_MISMATCHED:
        raise CpunetError(
            f"{text}: these energies are not those of these traces",
            "give the energy column of the same channel and events, in their order; select "
            "lower energies (`peak`) where amplitudes saturate, cut samples that pad records",
        )
    if share > FEW_MISMATCHED:
        log.warning(text)
    if (begins := second_rate(traces)) is not None:
        log.warning(
            f"{path}: noise and slope of the tails change at sample {begins[0]}, as if "
            f"{begins[1]:.0f} samples were averaged from there: a second rate; cut the traces "
            "there, or resample them"
        )
