"""What is in a file of pulses or in a run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import label_peaks
from cpunet.pulses.reading import open_pulses
from cpunet.recipes.schema import PeakConfig
from cpunet.regular_files import read_text
from cpunet.yaml_files import MOST_BYTES, plain_json

_RUN_FILE = "run.json"


def describe(
    path: str | Path,
    *,
    table: str | None = None,
    energy: str | None = None,
    kev_per_adc: float | None = None,
    dt_ns: float | None = None,
    peaks: Mapping[str, PeakConfig] | None = None,
) -> dict[str, Any]:
    """Say what a file of pulses or the folder of a training run holds.

    A file is read through once, in blocks, so that memory does not grow with it.

    Parameters
    ----------
    path
        The file, or a folder with ``run.json``.
    table, energy, kev_per_adc, dt_ns
        As for `cpunet.pulses.reading.open_pulses`.
    peaks
        Gamma lines whose pulses are counted.

    Returns
    -------
    dict
        For a run, ``kind`` (``"run"``), ``path`` and the content of ``run.json``.
        For a file, ``kind`` (``"pulses"``), ``path``, what
        `PulseSource.describe` gives, and: ``n_pulses``; ``energy_kev`` (lowest and
        highest, None if not known) and ``n_without_energy``; ``peaks`` (pulses by
        line); ``samples`` (lowest and highest, of traces all finite);
        ``n_not_finite`` and ``n_constant`` traces.

    Raises
    ------
    CpunetError
        If there is no such file, or it cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(Path(folder) / "pulses.npy", np.zeros((3, 8)))
    ...     told = describe(Path(folder) / "pulses.npy", dt_ns=16)
    >>> told["n_pulses"], told["length"], told["n_constant"]
    (3, 8, 3)
    """
    path = Path(path)
    if path.is_dir():
        return {"kind": "run", "path": str(path), **_run(path)}
    source = open_pulses(path, table=table, energy=energy, kev_per_adc=kev_per_adc, dt_ns=dt_ns)
    counts = _Counts(dict.fromkeys(peaks or {}, 0))
    for block in source.blocks():
        counts.add(block, peaks or {})
    return {"kind": "pulses", "path": str(path), **source.describe(), **counts.summary()}


@dataclass
class _Counts:
    """Sums and extremes over blocks."""

    peaks: dict[str, int]
    n_pulses: int = 0
    n_without_energy: int = 0
    n_not_finite: int = 0
    n_constant: int = 0
    energy_kev: list[float] = field(default_factory=list)
    samples: list[float] = field(default_factory=list)

    def add(self, block: Pulses, peaks: Mapping[str, PeakConfig]) -> None:
        self.n_pulses += len(block)
        known = block.energy_kev[np.isfinite(block.energy_kev)]
        self.n_without_energy += len(block) - len(known)
        self.energy_kev = _range([*self.energy_kev, *_extremes(known)])
        names, counts = np.unique(label_peaks(known, peaks), return_counts=True)
        for name, count in zip(names, counts, strict=True):
            if name:
                self.peaks[str(name)] += int(count)
        # A sum is NaN or infinite if one sample is, without a mask as large as the block.
        with np.errstate(invalid="ignore", over="ignore"):
            finite = np.isfinite(block.waveforms.sum(axis=1, dtype=np.float64))
        self.n_not_finite += int((~finite).sum())
        good = block.waveforms if finite.all() else block.waveforms[finite]
        low, high = good.min(axis=1), good.max(axis=1)
        self.n_constant += int((low == high).sum())
        self.samples = _range([*self.samples, *_extremes(low), *_extremes(high)])

    def summary(self) -> dict[str, Any]:
        return {
            "n_pulses": self.n_pulses,
            "energy_kev": self.energy_kev or None,
            "n_without_energy": self.n_without_energy,
            "peaks": self.peaks,
            "samples": self.samples or None,
            "n_not_finite": self.n_not_finite,
            "n_constant": self.n_constant,
        }


def _extremes(values: np.typing.NDArray[Any]) -> list[float]:
    return [float(values.min()), float(values.max())] if values.size else []


def _range(values: list[float]) -> list[float]:
    return [min(values), max(values)] if values else []


def _run(folder: Path) -> dict[str, Any]:
    file = folder / _RUN_FILE
    if not file.is_file():
        raise CpunetError(
            f"{folder}: a folder without {_RUN_FILE}; give the folder of a run, or a file"
        )
    try:
        content = plain_json(read_text(file, MOST_BYTES))
    except (OSError, ValueError) as error:
        raise CpunetError(
            f"{file}: cannot be read ({error}); the run is damaged, train it again"
        ) from error
    if not isinstance(content, dict):
        raise CpunetError(f"{file}: holds no run; train it again")
    return content
