r"""Test of additivity: the translated sum of two pulses against the sum of the translations.

A readout is linear: the response to an event with two sites is the sum of the responses to
the sites.  A network need not be linear, and a validation on single distributions does not
reveal it.

Two prepared pulses, aligned at the same sample, are summed with weights :math:`w` and
:math:`1 - w`, and the sum is translated.  A translation aligns its result at its maximum and
scales it by its tail, so neither shift nor height is known.  The residual is

.. math:: T(w x_1 + (1 - w) x_2)(t) - a \, T(x_1)(t - d_1) - b \, T(x_2)(t - d_2)

with the shifts :math:`d` and the heights :math:`a, b` that minimise its sum of squares.  It
is 0 for a linear response.  For any other it is a lower limit, since the free heights can
absorb a part of the nonlinearity.  With heights in the ratio of :math:`w` and :math:`1 - w`
(``shared``) they cannot.  The residual is then an upper limit: it also contains the linear
effect that a pulse whose charge arrives later has decayed less.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.interpolate

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]
Translate = Callable[[FloatArray], FloatArray]

PAIRS = 200
WEIGHTS = (0.2, 0.8)
EDGE_SAMPLES = 100
REACH = 32  # samples: largest shift of each part that is tried
STEPS = 12  # maximum number of Gauss-Newton steps
SMALLEST = 1e-7  # samples: a smaller step ends the fit


class _Fit(NamedTuple):
    """Fit of one pair: RMS of the residuals, size of the shifts, and their errors."""

    rms: float
    edge_rms: float
    shared_rms: float
    shared_edge_rms: float
    move_samples: float
    ambiguity_samples: float


class _Match(NamedTuple):
    """Shifts of the parts, the residual of the sum, and its derivatives."""

    moves: Values
    residual: Values
    jacobian: Values


def linearity_residual(
    translate: Translate,
    windows: FloatArray,
    rng: np.random.Generator,
    pairs: int = PAIRS,
    *,
    edge_samples: int = EDGE_SAMPLES,
) -> dict[str, Any]:
    """Compare translated sums of pulses with sums of translated pulses.

    Parameters
    ----------
    translate
        Function from prepared windows ``(n, length)`` to noise-free translated windows of the
        same shape, with rows of NaN where a translation fails.
    windows
        Prepared simulated pulses.
    rng
        Random generator of the pairs of different pulses and of the weights, which are
        uniform in 0.2 … 0.8.
    pairs
        Number of pairs.
    edge_samples
        Half-width of the window around the crossing of half the maximum for ``edge_rms``.

    Returns
    -------
    dict
        JSON-ready:

        ``pairs``, ``not_translated``, ``unmatched``
            pairs compared; left out because a pulse or the sum could not be translated; left
            out because no shift up to 32 samples fits.
        ``rms``, ``edge_rms``
            RMS of the residual in units of full charge, over the window and over the edge.
        ``shared_rms``, ``shared_edge_rms``
            the same with heights in the ratio of the weights.
        ``move_samples``
            shift of the parts (the larger of the two), in samples.
        ``ambiguity_samples``
            error of the difference of the two shifts if the residual were random with its
            RMS, at most 64.  For parts of similar shape it is large, which is harmless.

        The last six are ``{"median": …, "q90": …}`` over pairs.  If no pair is left
        there is ``missing`` with the reason instead.

    Raises
    ------
    CpunetError
        If there are fewer than 2 pulses, `pairs` is less than 1, or the translation differs in
        shape.
    """
    if windows.ndim != 2 or len(windows) < 2 or pairs < 1:
        raise CpunetError(
            f"{pairs} pairs of waveforms of shape {windows.shape}; give 2 pulses and a pair "
            "or more"
        )
    first = rng.integers(len(windows), size=pairs)
    second = (first + rng.integers(1, len(windows), size=pairs)) % len(windows)
    weight = rng.uniform(*WEIGHTS, size=pairs)[:, np.newaxis]
    sums = (weight * windows[first] + (1 - weight) * windows[second]).astype(np.float32)
    # each pulse is translated once, however many pairs have it
    used, places = np.unique([first, second], return_inverse=True)
    parts = _translated(translate, windows[used])
    of_sums = _translated(translate, sums)

    fits: list[_Fit] = []
    not_translated = unmatched = 0
    for total, one, other, w in zip(of_sums, *parts[places], weight[:, 0], strict=True):
        if not all(np.isfinite(pulse).all() for pulse in (total, one, other)):
            not_translated += 1
            continue
        fit = _compare(total, one, other, float(w), edge_samples)
        if fit is None:
            unmatched += 1
        else:
            fits.append(fit)
    return _summary(fits, not_translated, unmatched)


def _translated(translate: Translate, windows: FloatArray) -> Values:
    result = np.asarray(translate(windows), float)
    if result.shape != windows.shape:
        raise CpunetError(
            f"the translation has shape {result.shape} for windows of {windows.shape}; "
            "return a row for each"
        )
    return result


def _compare(
    total: Values, one: Values, other: Values, weight: float, edge_samples: int
) -> _Fit | None:
    """Fit shifts and heights of both parts to the translated sum."""
    inner = np.arange(REACH + 2, len(total) - REACH - 2)  # known for every shift
    if len(inner) < 8:
        return None
    target = total[inner]
    start = _best_whole_moves(target, one, other, inner)
    curves = [scipy.interpolate.CubicSpline(np.arange(len(p)), p) for p in (one, other)]
    free = _matched(curves, start, np.eye(2), inner, target)
    if free is None:
        return None
    shared = _matched(curves, free.moves, np.array([[weight], [1 - weight]]), inner, target)
    if shared is None:
        return None
    middle = int((target >= 0.5 * target.max()).argmax())
    near = slice(max(middle - edge_samples, 0), middle + edge_samples + 1)
    return _Fit(
        _rms(free.residual),
        _rms(free.residual[near]),
        _rms(shared.residual),
        _rms(shared.residual[near]),
        float(np.abs(free.moves).max()),
        _ambiguity(free.jacobian, _rms(free.residual)),
    )


def _matched(
    curves: list[Any],
    moves: Values,
    mixing: Values,
    inner: npt.NDArray[np.int64],
    target: Values,
) -> _Match | None:
    """Least squares in the shifts and heights; `mixing` maps heights to those of the parts."""
    for _ in range(STEPS):
        parts, heights, residual = _at(curves, moves, mixing, inner, target)
        slopes = np.stack(
            [-c(inner - d, 1) for c, d in zip(curves, moves, strict=True)], axis=1
        )
        jacobian = np.hstack([parts @ mixing, slopes * (mixing @ heights)])
        step = np.linalg.lstsq(jacobian, residual, rcond=1e-9)[0][-2:]
        trial = moves + np.clip(step, -1, 1)
        if (np.abs(trial) > REACH).any():
            return None
        left = _at(curves, trial, mixing, inner, target)[2]
        # near a kink of the pulse the spline's slope misleads
        if left @ left > residual @ residual:
            break
        moves = trial
        if np.abs(step).max() < SMALLEST:
            break
    return _Match(moves, _at(curves, moves, mixing, inner, target)[2], jacobian)


def _best_whole_moves(
    target: Values, one: Values, other: Values, inner: npt.NDArray[np.int64]
) -> Values:
    """The best shifts of the parts in whole samples, among all up to `REACH`."""
    moves = np.arange(-REACH, REACH + 1)
    a, b = (pulse[inner - moves[:, np.newaxis]] for pulse in (one, other))
    aa, bb = (a * a).sum(axis=1)[:, np.newaxis], (b * b).sum(axis=1)[np.newaxis]
    ab, at, bt = a @ b.T, (a @ target)[:, np.newaxis], (b @ target)[np.newaxis]
    determinant = aa * bb - ab**2
    alike = determinant <= 1e-12 * aa * bb  # two equal parts: one of them is enough
    safe = np.where(alike, 1, determinant)
    explained = (bb * at**2 - 2 * ab * at * bt + aa * bt**2) / safe
    explained = np.where(alike, at**2 / aa, explained)
    i, j = np.unravel_index(int(explained.argmax()), explained.shape)
    return np.array([moves[i], moves[j]], float)


def _at(
    curves: list[Any],
    moves: Values,
    mixing: Values,
    inner: npt.NDArray[np.int64],
    target: Values,
) -> tuple[Values, Values, Values]:
    """The shifted parts, the best heights and the residual."""
    columns = [c(inner - d) for c, d in zip(curves, moves, strict=True)]
    parts: Values = np.stack(columns, axis=1)
    heights = np.asarray(np.linalg.lstsq(parts @ mixing, target, rcond=1e-9)[0], float)
    return parts, heights, target - parts @ (mixing @ heights)


def _rms(values: Values) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _ambiguity(jacobian: Values, rms: float) -> float:
    """Error of the difference of the shifts, with heights and common shift free."""
    columns = np.column_stack(
        [jacobian[:, :2], jacobian[:, 2:].sum(axis=1), jacobian[:, 2] - jacobian[:, 3]]
    )
    others, wanted = columns[:, :3], 0.5 * columns[:, 3]
    left = wanted - others @ np.linalg.lstsq(others, wanted, rcond=1e-9)[0]
    # errors beyond the range of shifts are meaningless
    return float(min(rms / max(np.sqrt(left @ left), 1e-12), 2 * REACH))


def _summary(fits: list[_Fit], not_translated: int, unmatched: int) -> dict[str, Any]:
    counts = {"pairs": len(fits), "not_translated": not_translated, "unmatched": unmatched}
    if not fits:
        return counts | {"missing": "no pair of pulses could be translated and matched"}
    columns = dict(zip(_Fit._fields, np.array(fits).T, strict=True))
    return counts | {
        name: {"median": float(np.median(v)), "q90": float(np.quantile(v, 0.9))}
        for name, v in columns.items()
    }
