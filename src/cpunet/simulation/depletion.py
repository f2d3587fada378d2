r"""Depletion voltage from the linearity of the potential in the bias.

With space charge everywhere, the potential at a bias :math:`b` is :math:`b w + u`, where
:math:`w` is the potential of a unit bias on the lithium and :math:`u` that of the impurities.
This is the true potential if it has no pocket in which holes would collect: no local minimum
apart from the electrodes. At such a minimum, or wherever the potential is below 0, germanium
is not depleted.
"""

from __future__ import annotations

import heapq

import numpy as np
from scipy.ndimage import minimum_filter

from cpunet.simulation.geometry import GERMANIUM, FloatArray, RegionArray

# V: a pocket this shallow holds no charge (about kT/e at 90 K), and is not resolved by the
# grid
POCKET_DEPTH_V = 0.01
HIGHEST_BIAS_V = 20_000.0
_RESOLUTION_V = 0.5
_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j)


def depletion_voltage(bias: FloatArray, impurities: FloatArray, region: RegionArray) -> float:
    r"""Smallest bias in V at which the potential has no pocket; infinite if there is none.

    Parameters
    ----------
    bias, impurities
        Potentials of a unit bias, and of the impurities in V, shape (nr, nz).
    region
        Region of each node, as from `Detector.region`.

    Examples
    --------
    A planar detector of thickness :math:`d` depletes at :math:`e N d^2 / 2 \varepsilon`.

    >>> import numpy as np
    >>> z = np.tile(np.linspace(0, 10, 401), (3, 1))  # mm
    >>> impurities = -10 * z * (10 - z) / 2  # e N / epsilon = 10 V / mm2
    >>> region = np.where(z == 0, 0, np.where(z == 10, 1, 2))
    >>> bool(abs(depletion_voltage(z / 10, impurities, region) - 500) < 5)
    True
    """
    low, high = 0.0, HIGHEST_BIAS_V
    if has_pocket(high * bias + impurities, region):
        return float("inf")
    if not has_pocket(impurities, region):
        return 0.0
    while high - low > _RESOLUTION_V:
        middle = (low + high) / 2
        if has_pocket(middle * bias + impurities, region):
            low = middle
        else:
            high = middle
    return high


def has_pocket(potential: FloatArray, region: RegionArray) -> bool:
    """Whether `potential` (nr, nz), in V, keeps holes from reaching an electrode.

    Examples
    --------
    >>> import numpy as np
    >>> r, z = np.meshgrid(np.arange(9), np.arange(9), indexing="ij")
    >>> region = np.where(z == 0, 0, 2)
    >>> has_pocket(z * 10.0, region), has_pocket((z - 4.0) ** 2, region)
    (False, True)
    """
    minima = (potential <= minimum_filter(potential, size=3, mode="nearest")) & (
        region == GERMANIUM
    )
    # deepest first: a true pocket is found early
    where = np.argwhere(minima)
    order = np.argsort(potential[minima])
    return any(_holds(potential, region, *map(int, where[k])) for k in order)


def _holds(potential: FloatArray, region: RegionArray, row: int, column: int) -> bool:
    """Whether leaving a minimum requires a climb of more than `POCKET_DEPTH_V`.

    Floods from the minimum, lowest node first, until a lower node or a contact is reached.
    """
    start = potential[row, column]
    heap = [(float(start), row, column)]
    seen = {(row, column)}
    while heap:
        level, i, j = heapq.heappop(heap)
        if level > start + POCKET_DEPTH_V:
            return True
        if level < start or region[i, j] < GERMANIUM:
            return False
        for di, dj in _NEIGHBOURS:
            node = (i + di, j + dj)
            inside = 0 <= node[0] < region.shape[0] and 0 <= node[1] < region.shape[1]
            if inside and node not in seen:
                seen.add(node)
                heapq.heappush(heap, (float(potential[node]), *node))
    return True
