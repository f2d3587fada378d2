"""Where the lines of a spectrum are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.ndimage

Values = npt.NDArray[np.float64]

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


# Gamma lines in keV of the sources that detectors are calibrated with (ENSDF), strongest in a
# spectrum first; single and double escape of Tl-208 among them.
SOURCES = {
    "Th-228": (2614.511, 583.187, 238.632, 510.77, 1592.511, 2103.511, 727.33, 860.56),
    "Co-60": (1332.492, 1173.228),
    "Co-56": (846.770, 1238.288, 2598.500, 1771.357, 1037.843, 3253.503),
}
LOG_BIN = 0.002  # of the logarithm of the amplitude
BACKGROUND = 25  # bins to either side, whose median is what lies under a line
HIGHEST = 12.0  # standard deviations that one line counts at most
CLEAR, FEWEST_LINES = 4.0, 3  # a line is clear above so many; so many lines are needed


class Suggestion(NamedTuple):
    """A calibration that puts lines of a source where they belong.

    Parameters
    ----------
    kev_per_adc
        keV for one unit of the amplitude.
    source
        Whose lines they are.
    lines_kev
        Those that stand out.
    """

    kev_per_adc: float
    source: str
    lines_kev: tuple[float, ...]

    def __str__(self) -> str:
        lines = ", ".join(f"{line:.0f}" for line in sorted(self.lines_kev))
        return f"{self.source} ({lines} keV) at --kev-per-adc {self.kev_per_adc:.4g}"


def suggested_calibration(amplitudes: npt.ArrayLike) -> Suggestion | None:
    """Look for the lines of calibration sources in a spectrum of amplitudes.

    On a logarithmic axis a calibration is a shift: that one is taken at which most lines meet
    an excess of counts.

    Parameters
    ----------
    amplitudes
        In any unit, shape ``(n,)``; may hold NaN.

    Returns
    -------
    Suggestion or None
        None if no source has enough lines in it.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> lines = np.repeat([2614.5, 583.2, 1592.5, 2103.5], [300, 600, 100, 90])
    >>> spectrum = np.append(rng.uniform(100, 2600, 3000), rng.normal(lines, 1.5))
    >>> found = suggested_calibration(spectrum / 0.065)
    >>> found.source, round(found.kev_per_adc, 4)
    ('Th-228', 0.065)
    """
    known = np.asarray(amplitudes, float)
    known = np.log(known[np.isfinite(known) & (known > 0)])
    if len(known) < FEWEST:
        return None
    edges = np.arange(known.min() - LOG_BIN, known.max() + 2 * LOG_BIN, LOG_BIN)
    excess = _excess(np.histogram(known, edges)[0])
    found = [_shifted(excess, edges[0], source, SOURCES[source]) for source in SOURCES]
    clear = [one for one in found if one is not None]
    if not clear:
        return None
    _, log_factor, source, lines = max(clear, key=lambda one: one[0])
    return Suggestion(_refined(known, log_factor, lines), source, lines)


def _excess(counts: npt.NDArray[np.integer]) -> Values:
    """Counts of three bins above those beside them, in standard deviations."""
    beside = scipy.ndimage.median_filter(counts.astype(float), 2 * BACKGROUND + 1)
    smooth = scipy.ndimage.uniform_filter1d(counts.astype(float), 2 * BACKGROUND + 1)
    under = 3 * np.maximum(beside, 0.3 * smooth)
    near = np.convolve(counts, np.ones(3), "same")
    return np.asarray((near - under) / np.sqrt(np.maximum(under, 1.0)))


def _shifted(
    excess: Values, first: float, source: str, lines_kev: tuple[float, ...]
) -> tuple[float, float, str, tuple[float, ...]] | None:
    """The shift at which the lines of a source have most counts above those beside them."""
    places = np.log(lines_kev) / LOG_BIN
    offsets = np.round(places - places[0]).astype(int)
    n = len(excess)
    at = np.arange(n)[:, np.newaxis] + offsets
    inside = (at >= 0) & (at < n)
    values = np.where(inside, excess[np.clip(at, 0, n - 1)], 0.0)
    # the first line, the strongest one, has to be there
    score = np.clip(values, -CLEAR, HIGHEST).sum(axis=1)
    score[values[:, 0] < CLEAR] = -np.inf
    best = int(score.argmax())
    # two lines alone meet by chance more easily than three
    limit = CLEAR if len(lines_kev) > 2 else 2 * CLEAR
    clear = tuple(
        line for line, value in zip(lines_kev, values[best], strict=True) if value > limit
    )
    if not np.isfinite(score[best]) or len(clear) < min(FEWEST_LINES, len(lines_kev)):
        return None
    log_factor = float(places[0] * LOG_BIN - first - (best + 0.5) * LOG_BIN)
    return float(score[best]), log_factor, source, clear


def _refined(log_amplitudes: Values, log_factor: float, lines_kev: tuple[float, ...]) -> float:
    """The factor from the amplitudes near the highest of the lines."""
    line = max(lines_kev)
    near = np.abs(log_amplitudes + log_factor - np.log(line)) < 2 * LOG_BIN
    middle = float(np.median(log_amplitudes[near])) if near.any() else np.log(line) - log_factor
    return float(line / np.exp(middle))
