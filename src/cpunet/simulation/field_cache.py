"""Solved maps on disk, so that each detector is solved once."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from cpunet.errors import CpunetError
from cpunet.files import written_aside

# part of the name: maps of an older solver are not taken
SOLVER_VERSION = 1

_NUMBERS = ("grid_mm", "capacitance_pF", "depletion_V")
_ARRAYS = (
    "r_mm",
    "z_mm",
    "potential_V",
    "e_r_V_per_cm",
    "e_z_V_per_cm",
    "weighting_potential",
    "point_type",
)


def cache_file(key: str) -> Path:
    """Where the maps of a detector with fingerprint `key` are kept."""
    folder = os.environ.get("CPUNET_CACHE") or platformdirs.user_cache_dir("cpunet")
    return Path(folder) / "fields" / f"{key}-{SOLVER_VERSION}.npz"


def load(key: str) -> dict[str, Any] | None:
    """Take the maps of `key` from the cache; None if they are not there or damaged."""
    try:
        # opened here: numpy leaves a damaged file open
        with cache_file(key).open("rb") as file, np.load(file, allow_pickle=False) as kept:
            maps: dict[str, Any] = {name: kept[name] for name in _ARRAYS}
            maps |= {name: float(kept[name]) for name in _NUMBERS}
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None  # solved anew, and written over
    shape = (len(maps["r_mm"]), len(maps["z_mm"]))
    whole = all(maps[name].shape == shape for name in _ARRAYS[2:])
    return maps if whole else None


def store(key: str, maps: dict[str, Any]) -> None:
    """Keep `maps` in the cache, whole or not at all; a cache that cannot be written is none."""
    try:
        with written_aside(cache_file(key)) as aside:
            np.savez(aside, **maps)
    except CpunetError:
        return  # a read-only home must not stop a simulation
