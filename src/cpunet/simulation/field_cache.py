"""Solved potentials on disk, so that each detector is solved once."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import platformdirs

from cpunet.errors import CpunetError
from cpunet.files import written_aside
from cpunet.simulation.grid import Grid
from cpunet.simulation.poisson import Potentials

# part of the name: what an older solver found is not taken
SOLVER_VERSION = 2

_OF_GRID = ("r_mm", "z_mm", "region", "r_steps", "z_steps")
_OF_NODES = ("point_contact", "bias", "impurities", "tilt", "surface")


def cache_file(key: str) -> Path:
    """Where the potentials of a detector with fingerprint `key` are kept."""
    folder = os.environ.get("CPUNET_CACHE") or platformdirs.user_cache_dir("cpunet")
    return Path(folder) / "fields" / f"{key}-{SOLVER_VERSION}.npz"


def load(key: str, step_mm: float) -> tuple[Grid, Potentials, float] | None:
    """Take grid, potentials and depletion voltage (V) of `key` from the cache.

    None if they are not there or damaged.
    """
    try:
        # opened here: numpy leaves a damaged file open
        with cache_file(key).open("rb") as file, np.load(file, allow_pickle=False) as kept:
            axes = {name: kept[name] for name in _OF_GRID}
            nodes = {name: kept[name] for name in _OF_NODES}
            capacitance, depletion = float(kept["capacitance_pF"]), float(kept["depletion_V"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None  # solved anew, and written over
    shape = (len(axes["r_mm"]), len(axes["z_mm"]))
    if any(values.shape != shape for values in (axes["region"], *nodes.values())):
        return None
    grid = Grid(step_mm=step_mm, **axes)
    return grid, Potentials(**nodes, capacitance_pF=capacitance), depletion


def store(key: str, grid: Grid, potentials: Potentials, depletion_V: float) -> None:
    """Keep them in the cache, whole or not at all; a cache that cannot be written is none."""
    arrays = {name: getattr(grid, name) for name in _OF_GRID}
    arrays |= {name: getattr(potentials, name) for name in _OF_NODES}
    arrays["capacitance_pF"] = np.array(potentials.capacitance_pF)
    arrays["depletion_V"] = np.array(depletion_V)
    try:
        with written_aside(cache_file(key)) as aside:
            np.savez(aside, allow_pickle=False, **arrays)
    except CpunetError:
        return  # a read-only home must not stop a simulation
