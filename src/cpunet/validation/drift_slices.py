"""Mean pulses in slices of rise time: where in the detector a translation is wrong.

Pulses of one slice come from the same regions of the detector and differ by their sites
and by noise.  Their mean, aligned at half maximum, is the slice's superpulse.  Its standard
error is known, so a difference between simulation and data can be distinguished from chance.

Pulses are ordered by their rise time from 1 to 90 % (``rise_01_90``), which starts with the
pulse and ends while it still rises.  The paper's drift time ends at the maximum, which on a
flat top depends on the noise and would smear the slices.

The slices are bounded by quantiles of the rise times of the *data*.  Each method is sliced
by its own rise times: a method with the wrong response has different events in a slice, which
counts against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.validation.mean_pulse import known_mean

Values = npt.NDArray[np.float64]

SLICES = 4
MIN_PULSES = 10  # minimum pulses of a slice for an error of its mean
EDGE_SAMPLES = 100


@dataclass(frozen=True, eq=False)
class Superpulse:
    """The mean of aligned pulses.

    Attributes
    ----------
    mean, error
        Mean and its standard error, shape ``(before + after,)``, in pulse heights; NaN where
        fewer than 2 pulses contribute.  Errors of neighbouring samples are correlated.
    n
        Number of pulses in the mean.
    """

    mean: Values
    error: Values
    n: int


@dataclass(frozen=True, eq=False)
class Slices:
    """The superpulses of a dataset by rise time, and the number of pulses left out.

    Attributes
    ----------
    pulses, edges
        Superpulse of each slice, and the edges of the slices in ns.
    before
        Samples before the crossing of half the maximum.
    left_out
        Number of pulses left out by reason: ``no_time``, ``outside`` the edges, ``unaligned``
        (no crossing).
    """

    pulses: tuple[Superpulse, ...]
    edges: Values
    before: int
    left_out: dict[str, int]


@dataclass(frozen=True, eq=False)
class Residual:
    """Superpulse of a method minus that of the data, with its error, in pulse heights."""

    difference: Values
    error: Values

    @property
    def z(self) -> Values:
        r"""Pull :math:`z = (\bar{x} - \bar{x}_{\mathrm{data}}) / \sigma`; NaN without error."""
        known = self.error > 0
        return np.where(known, self.difference / np.where(known, self.error, 1), np.nan)


def slice_edges(rise_time: Values, slices: int = SLICES) -> Values:
    """Edges of slices with equal numbers of measured pulses.

    Parameters
    ----------
    rise_time
        Rise times of the measured pulses in ns; NaN and infinity are ignored.
    slices
        Number of slices; one more edge is returned, in ns.

    Raises
    ------
    CpunetError
        If no time is finite.

    Examples
    --------
    >>> slice_edges(np.arange(101.0), slices=4)
    array([  0.,  25.,  50.,  75., 100.])
    """
    finite = rise_time[np.isfinite(rise_time)]
    if not finite.size:
        raise CpunetError("no measured pulse has a rise time; check the peak's selection")
    return np.quantile(finite, np.linspace(0, 1, slices + 1))


def sliced(aligned: FloatArray, rise_time: Values, edges: Values, before: int) -> Slices:
    """Mean pulse of each slice.

    Parameters
    ----------
    aligned
        Pulses aligned by `align_half_maximum`, shape ``(n, samples)``.
    rise_time
        Rise time of each pulse in ns, shape ``(n,)``.
    edges
        Edges of the slices in ns, see `slice_edges`; the last slice includes its upper edge.
    before
        Number of samples before the crossing of half the maximum.
    """
    timed = np.isfinite(rise_time)
    inside = timed & (rise_time >= edges[0]) & (rise_time <= edges[-1])
    place = np.searchsorted(edges[1:-1], rise_time, side="right")
    found, unaligned = [], 0
    for i in range(len(edges) - 1):
        of_slice = aligned[inside & (place == i)]
        usable = np.isfinite(of_slice).any(axis=1)
        unaligned += int((~usable).sum())
        found.append(_mean(of_slice[usable]))
    left_out = {
        "no_time": int((~timed).sum()),
        "outside": int((timed & ~inside).sum()),
        "unaligned": unaligned,
    }
    return Slices(tuple(found), edges, before, left_out)


def slice_residuals(data: Slices, method: Slices) -> tuple[Residual | None, ...]:
    """Differences between the superpulses of a method and those of the data.

    Returns
    -------
    tuple
        Residual of each slice; None where a side has fewer than 10 pulses.

    Raises
    ------
    CpunetError
        If the two differ in their slices or their window.
    """
    alike = np.array_equal(data.edges, method.edges) and data.before == method.before
    if not alike or data.pulses[0].mean.shape != method.pulses[0].mean.shape:
        raise CpunetError(
            "superpulses of different slices or windows cannot be compared; "
            "take the data's edges for both"
        )
    return tuple(
        None
        if min(measured.n, other.n) < MIN_PULSES
        else Residual(other.mean - measured.mean, np.hypot(other.error, measured.error))
        for measured, other in zip(data.pulses, method.pulses, strict=True)
    )


def slice_table(
    sets: Mapping[str, Slices], dt_ns: float, edge_samples: int = EDGE_SAMPLES
) -> dict[str, Any]:
    """Deviations of each method's superpulses from those of the data.

    Parameters
    ----------
    sets
        Superpulses by method, the measured ones under ``"data"``.
    dt_ns
        Sampling period in ns.
    edge_samples
        Half-width of the evaluated window: ``2 * edge_samples + 1`` samples around the
        crossing.

    Returns
    -------
    dict
        JSON-ready:

        ``edges_ns``
            edges of the slices.
        ``left_out``
            number of pulses in no slice, by method and reason.
        ``slices``
            by method a list with, for each slice, ``n`` and ``n_data``; ``rms`` of the
            residual and ``rms_error``, its expectation by chance, both in percent of full
            charge; the ``largest`` residual in percent and its time from the crossing,
            ``largest_at_ns``; ``mean_abs_z`` and ``rms_z``, mean absolute pull and RMS pull
            (0.80 and 1 if there is no difference).  Or ``missing`` with the reason.

    Raises
    ------
    CpunetError
        If the datasets differ in their slices or their window.
    """
    data = sets["data"]
    return {
        "edges_ns": [float(edge) for edge in data.edges],
        "left_out": {method: dict(slices.left_out) for method, slices in sets.items()},
        "slices": {
            method: _rows(data, slices, dt_ns, edge_samples)
            for method, slices in sets.items()
            if method != "data"
        },
    }


def _mean(aligned: FloatArray) -> Superpulse:
    mean, count = known_mean(aligned)
    squares = np.nansum((aligned - mean) ** 2, axis=0)
    error = np.sqrt(squares / np.maximum(count - 1, 1) / np.maximum(count, 1))
    enough = count >= 2
    return Superpulse(
        np.where(enough, mean, np.nan), np.where(enough, error, np.nan), len(aligned)
    )


def _rows(data: Slices, method: Slices, dt_ns: float, edge_samples: int) -> list[Any]:
    near = slice(max(data.before - edge_samples, 0), data.before + edge_samples + 1)
    residuals = slice_residuals(data, method)
    rows: list[Any] = []
    for residual, own, measured in zip(residuals, method.pulses, data.pulses, strict=True):
        counts = {"n": own.n, "n_data": measured.n}
        if residual is None:
            few = f"{own.n} pulses beside {measured.n} measured ones"
            rows.append({**counts, "missing": f"{few} (at least {MIN_PULSES} are needed)"})
        else:
            rows.append({**counts, **_numbers(residual, near, data.before, dt_ns)})
    return rows


def _numbers(residual: Residual, near: slice, before: int, dt_ns: float) -> dict[str, Any]:
    difference, error, z = residual.difference[near], residual.error[near], residual.z[near]
    known, judged = np.isfinite(difference), np.isfinite(z)
    if not known.any():
        return {"missing": "no sample around the crossing is known on both sides"}
    worst = int(np.nanargmax(np.abs(difference)))
    return {
        "rms": 100 * _rms(difference[known]),
        "rms_error": 100 * _rms(error[known]),
        "largest": 100 * float(difference[worst]),
        "largest_at_ns": float((worst + near.start - before) * dt_ns),
        "mean_abs_z": float(np.abs(z[judged]).mean()) if judged.any() else None,
        "rms_z": _rms(z[judged]) if judged.any() else None,
    }


def _rms(values: Values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
