"""Scores of pulses whose true measured shape is known, pulse by pulse.

Two pulses are compared after both are shifted to cross half of their maximum at the same
time: a time shift left by the electronics or the alignment is not a difference of shape.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.half_maximum import Splines, last_below_half

Values = npt.NDArray[np.float64]

BLOCK = 512  # pulses per block: bounds memory


class PairedScores(TypedDict):
    """RMS differences of pulse pairs in units of the full charge, and pairs left out."""

    rmse: float
    edge_rmse: float
    unaligned: int


def align_half_maximum(waveforms: FloatArray, n_before: int, n_after: int) -> FloatArray:
    """Shift each pulse so that it crosses half of its maximum at sample `n_before`.

    The crossing is the last upward one before the maximum, searched backward from it.
    Its time and the shifted pulse are evaluated with the pulse's cubic spline; linear
    interpolation would smooth the edge.  The maximum is the largest sample of the pulse.
    Noise of relative RMS s on a flat top raises it by 2–3 s, and the level by 1–1.5 s.

    Parameters
    ----------
    waveforms
        Pulses of shape ``(n, length)`` with the baseline at 0.
    n_before, n_after
        Number of samples before the crossing, and from it on.

    Returns
    -------
    numpy.ndarray
        Float32, shape ``(n, n_before + n_after)``; NaN outside the record, and all NaN
        for a pulse without such a crossing or with a value that is not finite.

    Raises
    ------
    CpunetError
        If `waveforms` is not of shape (pulses, samples), or a pulse has fewer than 2 samples.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(100)
    >>> pulses = np.array([1 / (1 + np.exp((t0 - time) / 3)) for t0 in (40.3, 51.8)])
    >>> align_half_maximum(pulses, 2, 3).round(3)
    array([[0.339, 0.417, 0.5  , 0.583, 0.661],
           [0.339, 0.417, 0.5  , 0.583, 0.661]], dtype=float32)
    """
    _check_shape(waveforms)
    aligned = np.empty((len(waveforms), n_before + n_after), np.float32)
    for first in range(0, len(waveforms), BLOCK):
        rows = slice(first, first + BLOCK)
        aligned[rows] = _aligned(waveforms[rows], n_before, n_after)
    return aligned


def pair_squares(
    methods: Mapping[str, FloatArray], truth: FloatArray, edge_samples: int
) -> dict[str, Values]:
    """Squared differences from the true shapes, pulse by pulse, aligned at half maximum.

    Parameters
    ----------
    methods
        Translated pulses by method, shape ``(n, length)``.
    truth
        True shapes of the same events.
    edge_samples
        Half-width of the edge window in samples.

    Returns
    -------
    dict
        Arrays of shape ``(n, 4)`` by method: sum of squares and number of samples, over all
        samples that both records of a pair have, and over the ``2 * edge_samples + 1`` samples
        around the crossing; all 0 where a pulse cannot be aligned.

    Raises
    ------
    CpunetError
        If the numbers of pulses differ, or the arrays do not have the shape of pulses.
    """
    _check_shape(truth)
    for translated in methods.values():
        _check_shape(translated)
        if len(translated) != len(truth):
            raise CpunetError(
                f"{len(translated)} translated pulses cannot be paired with {len(truth)} true "
                "ones; give the same events in the same order"
            )
    found = {method: np.zeros((len(truth), 4)) for method in methods}
    for first in range(0, len(truth), BLOCK):
        rows = slice(first, first + BLOCK)
        aligned: dict[int, Values] = {}  # of the truth, by half-width
        for method, translated in methods.items():
            half = max(truth.shape[1], translated.shape[1])
            if half not in aligned:
                aligned[half] = _aligned(truth[rows], half, half)
            difference = _aligned(translated[rows], half, half)
            difference -= aligned[half]
            edge = slice(max(half - edge_samples, 0), half + edge_samples + 1)
            found[method][rows, :2] = _squares(difference)
            found[method][rows, 2:] = _squares(difference[:, edge])
    return found


def scores_of_squares(squares: Values) -> PairedScores:
    r"""Root-mean-square differences from the truth, from the result of `pair_squares`.

    .. math:: \mathrm{RMSE} = \sqrt{\frac{1}{N} \sum_{p, k} (x_{pk} - y_{pk})^2}

    over pulses :math:`p` and samples :math:`k`.

    Returns
    -------
    dict
        ``rmse`` and ``edge_rmse`` in units of the full charge (NaN if no pair is left), and
        ``unaligned``, the number of pairs left out because one of the two does not cross
        half of its maximum.

    Examples
    --------
    A time shift is no difference of shape:

    >>> import numpy as np
    >>> time = np.arange(100)
    >>> early, late = np.array([1 / (1 + np.exp((t0 - time) / 3)) for t0 in (40, 50)])
    >>> squares = pair_squares({"ren": late[None]}, early[None], edge_samples=10)
    >>> round(scores_of_squares(squares["ren"])["rmse"], 6)
    0.0
    """
    total = squares.sum(axis=0)
    return {
        "rmse": _root_mean(total[:2]),
        "edge_rmse": _root_mean(total[2:]),
        "unaligned": int((squares[:, 1] == 0).sum()),
    }


def _check_shape(waveforms: FloatArray) -> None:
    if waveforms.ndim != 2 or waveforms.shape[1] < 2:
        raise CpunetError(
            f"waveforms have shape {waveforms.shape}; "
            "expected (pulses, samples) with 2 samples or more"
        )


def _aligned(waveforms: FloatArray, n_before: int, n_after: int) -> Values:
    """One block of `align_half_maximum`, in float64."""
    moved = np.full((len(waveforms), n_before + n_after), np.nan)
    usable, before = last_below_half(waveforms)
    if usable.any():
        pulses = waveforms[usable]
        splines = Splines(pulses)
        level = 0.5 * pulses.max(axis=1).astype(float)
        times = splines.crossing(before[usable], level)
        moved[usable] = splines.shifted(times, n_before, n_after)
    return moved


def _squares(difference: Values) -> Values:
    """Sum of squares of the values that are not NaN, and their number, row by row."""
    known = np.isfinite(difference)
    values = np.where(known, difference, 0)
    return np.stack([np.einsum("ij,ij->i", values, values), known.sum(axis=1)], axis=1)


def _root_mean(sum_and_count: Values) -> float:
    total, count = sum_and_count
    return float(np.sqrt(total / count)) if count else float("nan")
