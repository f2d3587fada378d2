"""Hits from a NumPy archive: one array per quantity, with units in the names."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.reading.arrays import read_arrays
from cpunet.simulation.hit_readers.steps import Steps, whole_numbers

_NEEDED = ("x_mm", "y_mm", "z_mm", "edep_keV", "offsets")


def read_npz(path: Path) -> Steps:
    """Read the steps of an archive. Event i owns rows ``offsets[i]:offsets[i + 1]``."""
    arrays = read_arrays(path)
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise CpunetError(f"{path}: no array {missing[0]}; hits need {', '.join(_NEEDED)}")
    for name in _NEEDED:
        values = arrays[name]
        if values.ndim != 1 or values.dtype.kind not in "iuf":
            raise CpunetError(
                f"{path}: array {name} is of {values.dtype} and shape {values.shape}; give "
                "one number per hit, and offsets of the events"
            )
    x, y, z, edep = (np.asarray(arrays[name], float) for name in _NEEDED[:-1])
    offsets = whole_numbers(path, "offsets", arrays["offsets"])
    rising = len(offsets) > 0 and offsets[0] == 0 and not np.any(np.diff(offsets) < 0)
    if not rising or {len(a) for a in (x, y, z, edep)} != {int(offsets[-1])}:
        raise CpunetError(f"{path}: offsets do not divide the hits into events")
    event = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    return Steps(event, np.stack([x, y, z], axis=1), edep)
