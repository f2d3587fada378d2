"""Gamma lines: which energies lie on them, and in ranges."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.recipes.schema import PeakConfig

_NUMBER = r"(\d+(?:\.\d*)?(?:[eE]\+?\d+)?)"
_RANGE = re.compile(rf"{_NUMBER}\s*-\s*{_NUMBER}?")


def label_peaks(
    energy_kev: npt.ArrayLike, peaks: Mapping[str, PeakConfig]
) -> npt.NDArray[np.str_]:
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
    energies = np.asarray(energy_kev, np.float64)
    names = np.array(["", *peaks])
    if not peaks:
        return np.zeros(len(energies), names.dtype)
    centres = np.array([peak.energy_kev for peak in peaks.values()])
    widths = np.array([peak.half_width_kev for peak in peaks.values()])
    distance = np.abs(energies[:, np.newaxis] - centres)
    # NaN is in no window, since every comparison with it is false.
    distance = np.where(distance <= widths, distance, np.inf)
    nearest = distance.argmin(axis=1)
    within = np.isfinite(distance.min(axis=1))
    return names[np.where(within, nearest + 1, 0)]


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
    peaks: Mapping[str, PeakConfig]
    chosen: tuple[str, ...] = ()
    ranges_kev: tuple[tuple[float, float], ...] = ()

    @property
    def parts(self) -> list[EnergySelection]:
        """Its lines and ranges, each as a selection of its own."""
        lines = [EnergySelection(name, self.peaks, (name,)) for name in self.chosen]
        return lines + [
            EnergySelection(
                f"{low:.12g}-" if high == np.inf else f"{low:.12g}-{high:.12g}",
                self.peaks,
                (),
                ((low, high),),
            )
            for low, high in self.ranges_kev
        ]

    @property
    def lines_in_ranges(self) -> list[str]:
        """Lines that were not chosen by name but lie in a chosen range."""
        return [
            name
            for name, line in self.peaks.items()
            if name not in self.chosen
            and any(low <= line.energy_kev < high for low, high in self.ranges_kev)
        ]

    def select(self, energy_kev: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Mask of the selected energies (keV, shape ``(n,)``); False for NaN."""
        energies = np.asarray(energy_kev, np.float64)
        mask = np.isin(label_peaks(energies, self.peaks), self.chosen)
        for low, high in self.ranges_kev:
            mask |= (energies >= low) & (energies < high)
        return mask


def parse_selection(text: str, peaks: Mapping[str, PeakConfig]) -> EnergySelection:
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
    chosen: list[str] = []
    ranges: list[tuple[float, float]] = []
    for part in (part.strip() for part in text.split(",")):
        if part in peaks:
            chosen.append(part)
            continue
        match = _RANGE.fullmatch(part)
        if match is None:
            names = ", ".join(peaks) or "none"
            raise CpunetError(
                f"energies {text!r}: {part!r} is no known peak ({names}) "
                "and no range in keV such as 300-3000 or 300-"
            )
        low, high = float(match[1]), float(match[2] or np.inf)
        if low >= high:
            raise CpunetError(
                f"energies {text!r}: the range {part!r} is empty; give the lower end first"
            )
        ranges.append((low, high))
    # what is given twice counts once
    lines_once, ranges_once = tuple(dict.fromkeys(chosen)), tuple(dict.fromkeys(ranges))
    return EnergySelection(text, peaks, lines_once, ranges_once)
