"""Provenance of a translated file, to decide whether it is the requested one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.pulses.provenance import TRANSLATION
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import Run

Record = dict[str, Any]


def source_print(source: PulseFile) -> Record:
    """Names, sizes and modification times of the input files, and how they are read.

    Pulses in memory have a digest instead.

    Raises
    ------
    CpunetError
        If a file does not exist.
    """
    if source.pulses is not None:
        content = source.pulses.waveforms, source.pulses.energy_kev
        digest = hashlib.sha256(b"".join(values.tobytes() for values in content))
        return {"files": [], "sha256": digest.hexdigest()}
    paths = [source.path]
    elsewhere = (source.energy or "").rpartition(":")[0]
    if elsewhere and Path(elsewhere).is_file():
        paths.append(Path(elsewhere))
    prints = []
    for path in paths:
        try:
            stat = path.stat()
        except OSError:
            raise CpunetError(f"{path}: no such file; check the name") from None
        prints.append({"name": path.name, "bytes": stat.st_size, "changed": stat.st_mtime_ns})
    return {
        "files": prints,
        "table": source.table,
        "energy": source.energy,
        "kev_per_adc": source.kev_per_adc,
        "dt_ns": source.dt_ns,
    }


def require_unchanged(source: PulseFile, before: Record) -> None:
    """Raise a `CpunetError` if a file changed since `before` was taken."""
    if source_print(source) != before:
        raise CpunetError(
            f"{source.path}: changed while it was read; translate it once it is complete"
        )


def run_print(run: Run) -> str:
    """Fingerprint of a run's weights and recipe."""
    return hashlib.sha256(f"{run.weights_sha256}{run.recipe!r}".encode()).hexdigest()


def finished(out: Path, wanted: Record) -> dict[str, Any]:
    """Counts of an existing output that was made as requested.

    Parameters
    ----------
    out
        A translated file.
    wanted
        ``source``, ``run`` and ``options``.

    Raises
    ------
    CpunetError
        If it does not record how it was made, or was made from another source, with another
        run or with other options.
    """
    found = _read(out)
    for what, value in wanted.items():
        if found.get(what) == value:
            continue
        told = f"another {what}"
        if what == "options" and isinstance(found.get(what), dict):
            theirs = found[what]
            other = [n for n in theirs | value if theirs.get(n, ...) != value.get(n, ...)]
            told = f"other options ({', '.join(other)})"
        raise CpunetError(f"{out}: was made with {told}; choose another `out` or give `force`")
    counts = found.get("counts")
    if not isinstance(counts, dict) or not all(map(_is_count, _counted(counts))):
        raise CpunetError(
            f"{out}: does not say how many pulses it holds; choose another `out` or give "
            "`force`"
        )
    return dict(counts)


def _counted(counts: Mapping[str, Any]) -> list[Any]:
    """Counts of a translation that must be whole numbers."""
    rejections = counts.get("rejections")
    reasons = rejections.values() if isinstance(rejections, dict) else [None]
    optional = [counts[name] for name in ("saturated",) if name in counts]
    return [counts.get("read"), counts.get("translated"), *optional, *reasons]


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def as_json(record: Record) -> str:
    """The provenance as text; options given from Python may be numbers of NumPy."""
    return json.dumps(record, default=np.generic.item)


def _read(out: Path) -> Record:
    try:
        with opened(out) as file:
            record = json.loads(file.attrs[TRANSLATION])
    except (CpunetError, LookupError, ValueError, TypeError):
        record = None
    if not isinstance(record, dict):
        raise CpunetError(
            f"{out}: is no translation that is finished; choose another `out` or give `force`"
        )
    return record
