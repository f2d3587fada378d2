"""Hits from a NumPy archive: one array per quantity, units in the names."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.simulation.hit_readers.steps import Steps

_NEEDED = ("x_mm", "y_mm", "z_mm", "edep_keV", "offsets")


def read_npz(path: Path) -> Steps:
    """Steps of an archive; event i owns the rows ``offsets[i]:offsets[i + 1]``."""
    try:
        with path.open("rb") as stream, np.load(stream) as archive:
            missing = [name for name in _NEEDED if name not in archive]
            if missing:
                raise CpunetError(
                    f"{path}: no array {missing[0]}; hits need {', '.join(_NEEDED)}"
                )
            x, y, z, edep, offsets = (archive[name] for name in _NEEDED)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise CpunetError(f"{path}: not a readable NPZ file; is it truncated?") from error
    lengths = {len(array) if array.ndim == 1 else -1 for array in (x, y, z, edep)}
    rising = offsets.ndim == 1 and len(offsets) > 0 and not np.any(np.diff(offsets) < 0)
    if not rising or lengths != {int(offsets[-1])} or offsets[0] != 0:
        raise CpunetError(f"{path}: offsets do not divide the hits into events")
    event = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    return Steps(event, np.stack([x, y, z], axis=1).astype(float), edep.astype(float))
