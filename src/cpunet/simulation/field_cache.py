"""Disk cache of solved potentials, so that each detector is solved only once."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import platformdirs

from cpunet.errors import CpunetError
from cpunet.outputs import written_aside
from cpunet.pulses.reading.arrays import read_arrays
from cpunet.simulation.grid import Grid
from cpunet.simulation.poisson import Potentials

# part of the file name, so that results of an older solver are not used
SOLVER_VERSION = 3

_OF_GRID = ("r_mm", "z_mm", "region", "r_steps", "z_steps")
_OF_NODES = ("point_contact", "bias", "impurities", "tilt", "surface")


def cache_file(key: str) -> Path:
    """Cache file of the potentials of a detector with the fingerprint `key`."""
    folder = os.environ.get("CPUNET_CACHE") or platformdirs.user_cache_dir("cpunet")
    return Path(folder) / "fields" / f"{key}-{SOLVER_VERSION}.npz"


def load(key: str, step_mm: float) -> tuple[Grid, Potentials, float] | None:
    """Load grid, potentials and depletion voltage (V) of `key` from the cache.

    Returns None if they are missing or damaged.
    """
    try:
        kept = read_arrays(cache_file(key))
        grid = Grid(step_mm=step_mm, **{name: kept[name] for name in _OF_GRID})
        nodes = {name: kept[name] for name in _OF_NODES}
        capacitance, depletion = float(kept["capacitance_pF"]), float(kept["depletion_V"])
    except (CpunetError, LookupError):
        return None  # solved again and overwritten
    return grid, Potentials(**nodes, capacitance_pF=capacitance), depletion


def store(key: str, grid: Grid, potentials: Potentials, depletion_V: float) -> None:
    """Write to the cache atomically. A cache that cannot be written is ignored."""
    arrays = {name: getattr(grid, name) for name in _OF_GRID}
    arrays |= {name: getattr(potentials, name) for name in _OF_NODES}
    arrays["capacitance_pF"] = np.array(potentials.capacitance_pF)
    arrays["depletion_V"] = np.array(depletion_V)
    try:
        with written_aside(cache_file(key)) as aside:
            np.savez(aside, allow_pickle=False, **arrays)
    except CpunetError:
        return  # a read-only home directory must not stop a simulation
