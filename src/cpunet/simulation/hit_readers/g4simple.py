"""Step-wise HDF5 ntuples of g4simple, in the Geant4 units MeV and mm."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.hit_readers.steps import Steps, whole_numbers

NTUPLE = "default_ntuples/g4sntuple"


def read_g4simple(path: Path, ntuple: h5py.Group, detector: str | None) -> Steps:
    """Read the steps in the volume with number `detector` (``volID``), or in the only one."""
    edep = _column(path, ntuple, "Edep") * 1e3
    rows = len(edep)
    x, y, z, event = (_column(path, ntuple, name) for name in ("x", "y", "z", "event"))
    if any(len(column) != rows for column in (x, y, z, event)):
        raise CpunetError(f"{path}: columns of {NTUPLE} differ in length; is it truncated?")
    steps = Steps(whole_numbers(path, "event", event), np.stack([x, y, z], axis=1), edep)
    if "volID" not in ntuple:
        if detector is not None:
            raise CpunetError(f"{path}: no column volID to pick detector {detector} by")
        return steps
    volume = _column(path, ntuple, "volID")
    if len(volume) != rows:
        raise CpunetError(f"{path}: columns of {NTUPLE} differ in length; is it truncated?")
    return of_detector(path, steps, volume, detector)


def of_detector(
    path: Path, steps: Steps, number: npt.NDArray[np.float64], detector: str | None
) -> Steps:
    """Select the steps of a detector by its number, or of the only one if none is given."""
    # a volume without deposits is not a detector but, for example, the world or a holder
    volumes = whole_numbers(path, "the detector's number", number)
    there = sorted({int(n) for n in np.unique(volumes[steps.edep_kev > 0])})
    names = ", ".join(map(str, there)) or "none"
    if detector is None:
        if len(there) > 1:
            raise CpunetError(
                f"{path}: holds detectors {names}; choose one with detector (--hits-detector)"
            )
        return steps
    known = {str(n): n for n in there}
    if detector not in known:
        raise CpunetError(f"{path}: no detector {detector}; it holds {names}")
    mine = volumes == known[detector]
    return Steps(steps.event[mine], steps.position_mm[mine], steps.edep_kev[mine])


def _column(path: Path, ntuple: h5py.Group, name: str) -> npt.NDArray[np.float64]:
    pages = ntuple.get(f"{name}/pages")
    if not isinstance(pages, h5py.Dataset) or pages.ndim != 1 or pages.dtype.kind not in "iuf":
        raise CpunetError(
            f"{path}: no step-wise column {name} in {NTUPLE}; write it with g4simple's "
            "stepwise option"
        )
    return np.asarray(pages[()], float)
