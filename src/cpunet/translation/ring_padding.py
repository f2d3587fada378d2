"""Rings of templates beyond the crystal's surface, each the mean of its neighbours.

Whoever reads a library takes drift times between nodes and the template of the nearest one.
At the surface a node of the cell lies outside: without a template there, hits just inside get
no number.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Axis = npt.NDArray[np.float64]

RINGS = 3
_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))


def with_rings(
    templates: npt.NDArray[np.float32], rings: int = RINGS
) -> npt.NDArray[np.float32]:
    """Fill nodes without a template with the mean of those around, ring after ring.

    Parameters
    ----------
    templates
        Shape (r, z, samples); rows of NaN where there is none.  They are changed in place.
    rings
        How often.  What a node becomes depends on nodes no further away than this.

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


def _moved(held: npt.NDArray[np.bool_], i: int, j: int) -> npt.NDArray[np.bool_]:
    """The inner part of an array, seen from a neighbour."""
    n_r, n_z = held.shape
    return held[1 + i : n_r - 1 + i, 1 + j : n_z - 1 + j]
