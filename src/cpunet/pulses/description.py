"""What is in a file of pulses: counts, energies, lines of the spectrum, and all in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import label_peaks
from cpunet.pulses.provenance import provenance
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.reading.energies import amplitude
from cpunet.pulses.reading.opening import table_sizes
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.spectrum import Spectrum, Values, suggested_calibration
from cpunet.recipes.schema import PeakConfig
from cpunet.tables import counted, span


def describe_pulses(
    source: PulseSource, peaks: Mapping[str, PeakConfig]
) -> tuple[dict[str, Any], Spectrum]:
    """Describe the pulses of one table; also return their spectrum.

    The file is read in blocks; only energies or amplitudes of all pulses are held in memory.

    Parameters
    ----------
    source
        The opened file.
    peaks
        Gamma lines to count.

    Returns
    -------
    dict
        The result of `PulseSource.describe`, and: ``n_pulses``; ``energy_kev`` (lowest and
        highest, None if unknown) and ``n_without_energy``; ``peaks`` (number of pulses by
        line); ``amplitudes``, a suggested calibration if no energy is known, or else
        ``found``, the source whose lines are there, and at which share of their energies;
        ``samples`` (lowest and highest of the finite traces); the numbers ``n_not_finite``
        and ``n_constant`` of traces; ``provenance``, if the file records it.
    Spectrum
        Energies, or amplitudes if no energy is known.
    """
    counts = _Counts(dict.fromkeys(peaks, 0))
    for block in source.blocks():
        counts.add(block, peaks)
    spectrum = counts.spectrum()
    told = {"path": str(source.path), **source.describe(), **counts.summary(spectrum)}
    made = provenance(source)
    return told | ({"provenance": made} if made else {}), spectrum


def describe_tables(path: Path, dt_ns: float | None) -> dict[str, Any]:
    """Description of each table without reading its traces, or why it cannot be read."""
    told: dict[str, Any] = {}
    for table, number in table_sizes(path).items():
        try:
            source = open_pulses(path, table=table, dt_ns=dt_ns)
        except CpunetError as error:
            told[table] = str(error).removeprefix(f"{path}: ")
        else:
            told[table] = source.describe()
            if number is not None:
                told[table]["n_pulses"] = number
    return told


def pulses_in_words(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and texts for the result of `describe_pulses`."""
    lines = [
        ("file", str(told["path"])),
        ("format", f"{told['format']}, table {told['table']}"),
        (
            "traces",
            f"{told['n_pulses']} of {told['length']} samples, every {told['dt_ns']:g} ns",
        ),
        ("columns", ", ".join(told["columns"])),
        *((name, text) for name, text in told.get("provenance", {}).items()),
        ("energy", _energy(told)),
        ("lines", counted(told["peaks"])),
        ("source", told.get("found", "")),
        ("amplitudes", told.get("amplitudes", "")),
        ("samples", f"values {span(told['samples'])}{_odd(told)}"),
    ]
    return [(name, text) for name, text in lines if text]


def _energy(told: Mapping[str, Any]) -> str:
    text = str(told["energy"])
    if told["energy_kev"]:
        text += f", {span(told['energy_kev'])} keV"
        if told["n_without_energy"]:
            text += f"; {told['n_without_energy']} pulses have none"
    return text


def _odd(told: Mapping[str, Any]) -> str:
    """Numbers of traces that are not pulses, if any."""
    counts = {"not finite": told["n_not_finite"], "constant": told["n_constant"]}
    return "".join(f"; {n} traces {what}" for what, n in counts.items() if n)


@dataclass
class _Counts:
    """Sums and extremes over blocks."""

    peaks: dict[str, int]
    n_pulses: int = 0
    n_without_energy: int = 0
    n_not_finite: int = 0
    n_constant: int = 0
    amplitudes: list[Values] = field(default_factory=list)
    energies: list[Values] = field(default_factory=list)
    energy_kev: list[float] = field(default_factory=list)
    samples: list[float] = field(default_factory=list)

    def add(self, block: Pulses, peaks: Mapping[str, PeakConfig]) -> None:
        self.n_pulses += len(block)
        known = block.energy_kev[np.isfinite(block.energy_kev)]
        self.n_without_energy += len(block) - len(known)
        if len(known):
            self.energies.append(known)
        else:
            self.amplitudes.append(amplitude(block.waveforms))
        self.energy_kev = _range([*self.energy_kev, *_extremes(known)])
        names, counts = np.unique(label_peaks(known, peaks), return_counts=True)
        for name, count in zip(names, counts, strict=True):
            if name:
                self.peaks[str(name)] += int(count)
        # A sum is NaN or infinite if any sample is; this needs no mask as large as the block.
        with np.errstate(invalid="ignore", over="ignore"):
            finite = np.isfinite(block.waveforms.sum(axis=1, dtype=np.float64))
        self.n_not_finite += int((~finite).sum())
        good = block.waveforms if finite.all() else block.waveforms[finite]
        low, high = good.min(axis=1), good.max(axis=1)
        self.n_constant += int((low == high).sum())
        self.samples = _range([*self.samples, *_extremes(low), *_extremes(high)])

    def spectrum(self) -> Spectrum:
        """Energies of the pulses, or their amplitudes if no energy is known, with lines."""
        known = bool(self.energies)
        values = np.concatenate(self.energies or self.amplitudes or [np.empty(0)])
        return Spectrum(values, in_kev=known, found=suggested_calibration(values))

    def summary(self, spectrum: Spectrum) -> dict[str, Any]:
        found = spectrum.found
        lines = {} if spectrum.in_kev else {"amplitudes": "no lines that stand out"}
        if found is not None and spectrum.in_kev:
            place = 1 / found.kev_per_adc
            lines = {"found": f"lines of {found.source}, at {place:.4f} of their energies"}
        elif found is not None:
            lines = {"amplitudes": f"like {found}"}
        return {
            "n_pulses": self.n_pulses,
            "energy_kev": self.energy_kev or None,
            "n_without_energy": self.n_without_energy,
            "peaks": self.peaks,
            **lines,
            "samples": self.samples or None,
            "n_not_finite": self.n_not_finite,
            "n_constant": self.n_constant,
        }


def _extremes(values: np.typing.NDArray[Any]) -> list[float]:
    return [float(values.min()), float(values.max())] if values.size else []


def _range(values: list[float]) -> list[float]:
    return [min(values), max(values)] if values else []
