"""Gamma lines: which energies lie on them and in ranges, and where spectra have them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.recipes.schema import PeakConfig

Peaks = Mapping[str, PeakConfig]  # by name

_NUMBER = r"(\d+(?:\.\d*)?(?:[eE]\+?\d+)?)"
_RANGE = re.compile(rf"{_NUMBER}\s*-\s*{_NUMBER}?")

# Lines of a spectrum, see `line_near` and `suggested_calibration`
WITHIN = 0.03  # relative half-width of the search range of a line
BIN_KEV = 1.0
MIN_COUNTS = 30  # minimum counts in the highest bins of a line
ABOVE = 4.0  # minimum ratio of a line's counts to those around it
WIDTH_BINS = 3  # to either side of the highest bin; their mean is the energy
# Gamma lines in keV of common calibration sources (ENSDF), strongest in a spectrum first, with
# the single and double escape peaks of Tl-208.
SOURCES = {
    "Th-228": (2614.511, 583.187, 238.632, 510.77, 1592.511, 2103.511, 727.33, 860.56),
    "Co-60": (1332.492, 1173.228),
    "Co-56": (846.770, 1238.288, 2598.500, 1771.357, 1037.843, 3253.503),
}
MIN_BINS = 10  # minimum number of bins of a spectrum that may contain lines
LOG_BIN = 0.002  # bin width in the logarithm of the amplitude
BACKGROUND = 25  # bins to either side whose median is the background under a line
HIGHEST = 12.0  # maximum contribution of one line, in standard deviations
CLEAR, MIN_LINES = 4.0, 3  # significance of a clear line; clear lines required


def label_peaks(energy_kev: npt.ArrayLike, peaks: Peaks) -> npt.NDArray[np.str_]:
    """Name the gamma line whose window contains each energy.

    Parameters
    ----------
    energy_kev
        Energies in keV, shape ``(n,)``; NaN belongs to no line.
    peaks
        Gamma lines: energy and half-width of the window, both ends included.

    Returns
    -------
    numpy.ndarray
        Names, shape ``(n,)``; ``""`` for none.  Where windows overlap, the
        nearest line is taken.

    Examples
    --------
    >>> lines = {"FEP": PeakConfig(energy_kev=2614.511, half_width_kev=5)}
    >>> label_peaks([2610.0, 1000.0, np.nan], lines).tolist()
    ['FEP', '', '']
    """
    energies, names = np.asarray(energy_kev, np.float64), np.array(["", *peaks])
    lines = [(0.0, -1.0), *((peak.energy_kev, peak.half_width_kev) for peak in peaks.values())]
    centres, widths = np.transpose(lines)
    # NaN is in no window, since every comparison with it is false.
    distance = np.abs(energies[:, np.newaxis] - centres)
    inside = np.where(distance <= widths, distance, np.inf)
    nearest: npt.NDArray[np.intp] = inside.argmin(axis=1)
    return names[nearest]


@dataclass(frozen=True)
class EnergySelection:
    """Pulses on chosen lines or in chosen ranges of energy (see `parse_selection`).

    Parameters
    ----------
    name
        The selection as the user wrote it.
    peaks
        All lines; a pulse between two belongs to the nearest.
    chosen
        Names of the selected lines.
    ranges_kev
        Selected ranges in keV: lower end (included) and upper end (excluded).
    """

    name: str
    peaks: Peaks
    chosen: tuple[str, ...] = ()
    ranges_kev: tuple[tuple[float, float], ...] = ()

    @property
    def parts(self) -> list[EnergySelection]:
        """Its lines and ranges, each as a selection of its own."""
        parts = [EnergySelection(name, self.peaks, (name,)) for name in self.chosen]
        for low, high in self.ranges_kev:
            name = f"{low:.12g}-" if high == np.inf else f"{low:.12g}-{high:.12g}"
            parts.append(EnergySelection(name, self.peaks, (), ((low, high),)))
        return parts

    @property
    def lines_in_ranges(self) -> list[str]:
        """Lines that were not chosen by name but lie in a chosen range."""
        others = {name: line for name, line in self.peaks.items() if name not in self.chosen}
        in_ranges = replace(self, chosen=()).select([x.energy_kev for x in others.values()])
        return [name for name, inside in zip(others, in_ranges, strict=True) if inside]

    def select(self, energy_kev: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Mask of the selected energies (keV, shape ``(n,)``); False for NaN."""
        energies = np.asarray(energy_kev, np.float64)
        mask = np.isin(label_peaks(energies, self.peaks), self.chosen)
        for low, high in self.ranges_kev:
            mask |= (energies >= low) & (energies < high)
        return mask


def parse_selection(text: str, peaks: Peaks) -> EnergySelection:
    """Parse a selection: lines and ranges in keV, separated by commas.

    Parameters
    ----------
    text
        The selection, for example ``"FEP"``, ``"SEP,DEP"``, ``"300-3000"`` or ``"300-"``.
    peaks
        Known gamma lines.

    Raises
    ------
    CpunetError
        If a part is neither a known line nor a range; the message lists the lines.

    Examples
    --------
    >>> parse_selection("300-2000", {}).select([299.9, 300, 1999, 2000]).tolist()
    [False, True, True, False]
    """
    chosen, ranges = dict[str, None](), dict[tuple[float, float], None]()  # each counts once
    for part in (part.strip() for part in text.split(",")):
        if part in peaks:
            chosen[part] = None
        elif match := _RANGE.fullmatch(part):
            low, high = float(match[1]), float(match[2] or np.inf)
            if low >= high:
                raise CpunetError(
                    f"energies {text!r}: the range {part!r} is empty; give the lower end first"
                )
            ranges[low, high] = None
        else:
            names = ", ".join(peaks) or "none"
            raise CpunetError(
                f"energies {text!r}: {part!r} is no known peak ({names}) "
                "and no range in keV such as 300-3000 or 300-"
            )
    return EnergySelection(text, peaks, tuple(chosen), tuple(ranges))


def line_near(energies_kev: npt.ArrayLike, expected_kev: float) -> float | None:
    """Energy of the gamma line nearest to an expected energy.

    Parameters
    ----------
    energies_kev
        Energies of all pulses in keV, shape ``(n,)``; may contain NaN.
    expected_kev
        Expected energy of the line in keV; the search range is within 3 % of it.

    Returns
    -------
    float or None
        Energy in keV; None if no line stands out.

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
    # of equally high bins, the one nearest to the middle
    centre = 0.5 * (edges[1:] + edges[:-1])
    highest = np.flatnonzero(near == near.max())
    top = int(highest[np.abs(centre[highest] - expected_kev).argmin()])
    if near[top] < MIN_COUNTS or near[top] < ABOVE * max(3 * float(np.median(counts)), 1.0):
        return None
    part = slice(max(top - WIDTH_BINS, 0), top + WIDTH_BINS + 1)
    return float(np.average(centre[part], weights=counts[part]))


class Suggestion(NamedTuple):
    """An energy calibration that matches the gamma lines of a source.

    Parameters
    ----------
    kev_per_adc
        Energy in keV per unit of the amplitude.
    source
        Calibration source of the lines.
    lines_kev
        Energies in keV of these lines.
    """

    kev_per_adc: float
    source: str
    lines_kev: tuple[float, ...]

    def __str__(self) -> str:
        lines = ", ".join(f"{line:.0f}" for line in sorted(self.lines_kev))
        return f"{self.source} ({lines} keV) at `kev_per_adc` {self.kev_per_adc:.4g}"


def suggested_calibration(amplitudes: npt.ArrayLike) -> Suggestion | None:
    """Search a spectrum of amplitudes for the lines of calibration sources.

    On a logarithmic axis a calibration is a shift.  The chosen shift is the one at which the
    lines coincide best with excesses of counts.

    Parameters
    ----------
    amplitudes
        Amplitudes in any unit, shape ``(n,)``; may contain NaN.

    Returns
    -------
    Suggestion or None
        None if too few lines of every source stand out.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> lines = np.repeat([2614.5, 583.2, 1592.5, 2103.5], [300, 600, 100, 90])
    >>> spectrum = np.append(rng.uniform(100, 2600, 3000), rng.normal(lines, 1.5))
    >>> calibration = suggested_calibration(spectrum / 0.065)
    >>> calibration.source, round(calibration.kev_per_adc, 4)
    ('Th-228', 0.065)
    """
    logs = np.asarray(amplitudes, float)
    logs = np.log(logs[np.isfinite(logs) & (logs > 0)])
    if len(logs) < MIN_COUNTS:
        return None
    edges = np.arange(logs.min() - LOG_BIN, logs.max() + 2 * LOG_BIN, LOG_BIN)
    if len(edges) < MIN_BINS:  # one energy
        return None
    # excess of the counts of three bins over their background, in standard deviations
    counts = np.histogram(logs, edges)[0]
    reflected = np.pad(counts.astype(float), BACKGROUND, "symmetric")
    around = np.lib.stride_tricks.sliding_window_view(reflected, 2 * BACKGROUND + 1)
    under = 3 * np.maximum(np.median(around, axis=1), 0.3 * around.mean(axis=1))
    near = np.convolve(counts, np.ones(3), "same")
    excess = (near - under) / np.sqrt(np.maximum(under, 1.0))
    best, suggestion = -np.inf, None
    for source, lines_kev in SOURCES.items():
        places = np.log(lines_kev) / LOG_BIN
        offsets = np.round(places - places[0]).astype(int)
        at = np.arange(len(excess))[:, np.newaxis] + offsets
        inside = (at >= 0) & (at < len(excess))
        values = np.where(inside, excess[np.clip(at, 0, len(excess) - 1)], 0.0)
        # the first (strongest) line must be present
        score = np.clip(values, -CLEAR, HIGHEST).sum(axis=1)
        score[values[:, 0] < CLEAR] = -np.inf
        shift = int(score.argmax())
        # two lines coincide by chance more easily than three
        limit = CLEAR if len(lines_kev) > 2 else 2 * CLEAR
        clear = tuple(np.array(lines_kev)[values[shift] > limit].tolist())
        if score[shift] > best and len(clear) >= min(MIN_LINES, len(lines_kev)):
            # from the amplitudes near the highest line
            log_factor = float(places[0] * LOG_BIN - edges[0] - (shift + 0.5) * LOG_BIN)
            line = max(clear)
            of_line = logs[np.abs(logs + log_factor - np.log(line)) < 2 * LOG_BIN]
            middle = float(np.median(of_line)) if len(of_line) else np.log(line) - log_factor
            best = float(score[shift])
            suggestion = Suggestion(float(line / np.exp(middle)), source, clear)
    return suggestion
