"""Extrapolate templates and drift times to rings of nodes beyond the crystal's surface.

Readers of a library interpolate drift times between nodes and take the template of the nearest
one.  At the surface, some nodes of a cell are outside the crystal; without values there, hits
just inside would have none.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Axis = npt.NDArray[np.float64]

RINGS = 3  # number of rings
_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))


def with_rings(
    templates: npt.NDArray[np.float32], rings: int = RINGS
) -> npt.NDArray[np.float32]:
    """Fill nodes without a template with the mean of their neighbours, ring by ring.

    The mean of currents that are aligned at their maxima has the mean A/E.

    Parameters
    ----------
    templates
        Templates, shape ``(r, z, samples)``, NaN if there is none; changed in place.
    rings
        Number of rings; a node depends only on nodes at most this far away.

    Returns
    -------
    numpy.ndarray
        The same array.

    Examples
    --------
    >>> line = np.array([[[1.0], [3.0], [np.nan], [np.nan]]], np.float32)
    >>> with_rings(line, 1)[0, :, 0].tolist()
    [1.0, 3.0, 3.0, nan]
    """
    there = ~np.isnan(templates[:, :, 0])
    for _ in range(rings):
        held = np.pad(there, 1)
        around = np.sum([_moved(held, *step) for step in _NEIGHBOURS], axis=0)
        new_r, new_z = np.nonzero(~there & (around > 0))
        total = np.zeros((len(new_r), templates.shape[2]), np.float64)
        for i, j in _NEIGHBOURS:
            known = held[new_r + 1 + i, new_z + 1 + j]
            total[known] += templates[new_r[known] + i, new_z[known] + j]
        templates[new_r, new_z] = total / around[new_r, new_z][:, np.newaxis]
        there[new_r, new_z] = True
    return templates


def continued(times: Axis, rings: int = RINGS) -> Axis:
    """Extrapolate drift times linearly to nodes without one, ring by ring.

    Parameters
    ----------
    times
        Drift times in ns, shape ``(r, z)``; NaN if there is none.
    rings
        Number of rings.

    Returns
    -------
    numpy.ndarray
        Drift times in ns, shape ``(r, z)``. A new one is the mean of the linear extrapolations
        from two nodes in each of eight directions, or else the mean of its neighbours.

    Examples
    --------
    >>> continued(np.array([[4.0, 6.0, np.nan, np.nan]]), 2).tolist()
    [[4.0, 6.0, 8.0, 10.0]]
    """
    made = np.pad(times, 2, constant_values=np.nan)
    n_r, n_z = times.shape
    for _ in range(rings):
        near, far = (
            np.stack([_seen(made, n * i, n * j, n_r, n_z) for i, j in _NEIGHBOURS])
            for n in (1, 2)
        )
        inner = made[2 : 2 + n_r, 2 : 2 + n_z]
        best = _mean(2 * near - far)
        best = np.where(np.isnan(best), _mean(near), best)
        inner[...] = np.where(np.isnan(inner), best, inner)
    return made[2 : 2 + n_r, 2 : 2 + n_z].copy()


def padded_axis(axis: Axis, before: int, after: int) -> Axis:
    """Continue an ascending axis by its widest step on both sides.

    Examples
    --------
    >>> padded_axis(np.array([0.0, 0.5, 1.0]), 0, 2).tolist()
    [0.0, 0.5, 1.0, 1.5, 2.0]
    """
    step = float(np.diff(axis).max())
    low = axis[0] - step * np.arange(before, 0, -1)
    high = axis[-1] + step * np.arange(1, after + 1)
    return np.concatenate([low, axis, high])


def _seen(made: Axis, i: int, j: int, n_r: int, n_z: int) -> Axis:
    """Inner part of an array with a padding of two nodes, shifted by (i, j)."""
    return made[2 + i : 2 + i + n_r, 2 + j : 2 + j + n_z]


def _mean(values: Axis) -> Axis:
    """Mean of the finite values along the first axis; NaN if there is none."""
    known = np.isfinite(values)
    n = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(n > 0, total / np.maximum(n, 1), np.nan)


def _moved(held: npt.NDArray[np.bool_], i: int, j: int) -> npt.NDArray[np.bool_]:
    """Inner part of an array with a padding of one node, shifted by (i, j)."""
    n_r, n_z = held.shape
    return held[1 + i : n_r - 1 + i, 1 + j : n_z - 1 + j]
