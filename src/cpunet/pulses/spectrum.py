"""Where the lines of a spectrum are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

WITHIN = 0.03  # of its energy: where a line is looked for
BIN_KEV = 1.0
FEWEST = 30  # counts in the highest bins of a line
ABOVE = 4.0  # times the counts beside it: a line
WIDTH_BINS = 3  # to either side, whose mean is its energy


def line_near(energies_kev: npt.ArrayLike, expected_kev: float) -> float | None:
    """Energy of the line nearest to where one is expected.

    Parameters
    ----------
    energies_kev
        Of all pulses, shape ``(n,)``; may hold NaN.
    expected_kev
        Of the line; it is looked for within 3 % of it.

    Returns
    -------
    float or None
        In keV; None if no line stands out there.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> energies = np.append(rng.uniform(2300, 2900, 500), rng.normal(2601, 1, 1000))
    >>> round(line_near(energies, 2614.5))
    2601
    >>> line_near(energies[:500], 2614.5) is None
    True
    """
    low, high = (1 - WITHIN) * expected_kev, (1 + WITHIN) * expected_kev
    energies = np.asarray(energies_kev, float)
    edges = np.arange(low, high + BIN_KEV, BIN_KEV)
    counts, edges = np.histogram(energies[np.isfinite(energies)], edges)
    if len(counts) < 2 * WIDTH_BINS + 1:
        return None
    near = np.convolve(counts, np.ones(3), "same")
    # where several are as high, the one nearest to the middle
    centre = 0.5 * (edges[1:] + edges[:-1])
    highest = np.flatnonzero(near == near.max())
    top = int(highest[np.abs(centre[highest] - expected_kev).argmin()])
    if near[top] < FEWEST or near[top] < ABOVE * max(3 * float(np.median(counts)), 1.0):
        return None
    part = slice(max(top - WIDTH_BINS, 0), top + WIDTH_BINS + 1)
    return float(np.average(centre[part], weights=counts[part]))
