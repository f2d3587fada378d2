"""One entry point for all formats of hits, recognised by the content of the file."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np

from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.pulses.reading.arrays import read_arrays
from cpunet.simulation.hit_readers.csv_ntuple import read_csv
from cpunet.simulation.hit_readers.g4simple import NTUPLE, read_g4simple
from cpunet.simulation.hit_readers.hit_table import TABLE, read_hit_table
from cpunet.simulation.hit_readers.remage import detectors_of, parts_of, read_remage
from cpunet.simulation.hit_readers.steps import (
    ReadHits,
    Steps,
    Transform,
    Units,
    require_some,
    to_hits,
    whole_numbers,
)
from cpunet.simulation.hits import Hits

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ZIP_MAGIC = b"PK"
_CSV_MAGIC = b"#class tools::wcsv::ntuple"
_AS_IN_THE_FILE = Transform()
_NEEDED = ("x_mm", "y_mm", "z_mm", "edep_keV", "offsets")  # arrays of an NPZ


def read_hits(
    path: Path | str,
    *,
    detector: str | None = None,
    transform: Transform = _AS_IN_THE_FILE,
    length_unit: str | None = None,
    energy_unit: str | None = None,
) -> ReadHits:
    """Read the energy deposits of one detector.

    Formats: the hits stored with simulated pulses (``geds/hits``), remage LH5 (``stp``
    tables; the origin in ``detector_origins`` is subtracted), g4simple HDF5 and CSV
    ntuples (Geant4 units, MeV and mm), other Geant4 CSV ntuples, and NPZ with ``x_mm``,
    ``y_mm``, ``z_mm``, ``edep_keV``, ``offsets``.

    Parameters
    ----------
    path
        Path of the file.
    detector
        Detector to read: the name of the table in remage files, the number of the volume in
        g4simple files, the number of the detector in other CSV files. Not needed if there is
        only one.
    transform
        Transformation from the frame of the file to that of the crystal (z = 0 at the point
        contact).
    length_unit, energy_unit
        Units of columns that name none. An unknown or missing unit is an error.

    Raises
    ------
    CpunetError
        If the file cannot be read, has an unknown format, lacks a column, a unit or the
        detector, or contains no energy deposit.
    """
    return _whole(Path(path), detector, Units(length_unit, energy_unit), transform)


def _whole(path: Path, detector: str | None, units: Units, transform: Transform) -> ReadHits:
    found = to_hits(path, _steps(path, detector, units), transform)
    require_some(path, found.hits.n_events)
    return found


def hit_parts(
    path: Path | str,
    *,
    detector: str | None = None,
    transform: Transform = _AS_IN_THE_FILE,
    length_unit: str | None = None,
    energy_unit: str | None = None,
) -> Callable[[], Iterator[Hits]]:
    """Like `read_hits`, but in parts if possible, so that memory does not grow with the file.

    Tables of remage are read in parts, unless the rows of an event are not adjacent. All other
    files are read once and kept in memory.

    Returns
    -------
    callable
        Returns an iterator over the parts, from the first one, each time it is called.
    """
    file = Path(path)
    units = Units(length_unit, energy_unit)
    parts = parts_of(file, detector) if _is_remage(file) else None
    if parts is None or len(parts) < 2:
        whole = _whole(file, detector, units, transform).hits
        return lambda: iter([whole])

    def read() -> Iterator[Hits]:
        for rows in parts:
            yield to_hits(file, read_remage(file, detector, units, rows), transform).hits

    return read


def holds_hits(path: Path | str) -> bool:
    """Whether a file contains hits rather than pulses.

    Files of simulated pulses that also contain their hits count as files of pulses.
    """
    file = Path(path)
    start = _start(file)
    if start.startswith(_HDF5_MAGIC):
        with opened(file) as content:
            return any(isinstance(content.get(name), h5py.Group) for name in ("stp", NTUPLE))
    if start.startswith(_ZIP_MAGIC):
        with suppress(zipfile.BadZipFile), zipfile.ZipFile(file) as archive:
            return {"x_mm.npy", "offsets.npy"} <= set(archive.namelist())
        return False  # the reader of pulses reports the error
    return start == _CSV_MAGIC


def hit_detectors(path: Path | str) -> list[str]:
    """Names of the detectors of a remage file; empty for other formats."""
    return detectors_of(Path(path)) if _is_remage(Path(path)) else []


def _start(path: Path) -> bytes:
    """First bytes of a file; none if it cannot be read, which its reader reports."""
    try:
        with path.open("rb") as stream:
            return stream.read(len(_CSV_MAGIC))
    except OSError:
        return b""


def _is_remage(path: Path) -> bool:
    if not _start(path).startswith(_HDF5_MAGIC):
        return False
    with opened(path) as file:
        return isinstance(file.get("stp"), h5py.Group) and not isinstance(
            file.get(NTUPLE), h5py.Group
        )


def _steps(path: Path, detector: str | None, units: Units) -> Steps:
    try:
        with path.open("rb") as stream:
            start = stream.read(len(_CSV_MAGIC))
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror})") from error
    if start.startswith(_HDF5_MAGIC):
        return _hdf5(path, detector, units)
    if start.startswith(_ZIP_MAGIC):
        _without_detectors(path, detector)
        return _npz(path)
    if start.startswith(_CSV_MAGIC):
        return read_csv(path, detector, units)
    raise CpunetError(
        f"{path}: no known format of hits; expected remage LH5, g4simple HDF5, "
        "Geant4 CSV or NPZ"
    )


def _hdf5(path: Path, detector: str | None, units: Units) -> Steps:
    with opened(path) as file:
        if isinstance(file.get(NTUPLE), h5py.Group):
            return read_g4simple(path, file[NTUPLE], detector)
        is_remage, is_kept = isinstance(file.get("stp"), h5py.Group), TABLE in file
    if is_remage:
        return read_remage(path, detector, units)
    if is_kept:
        _without_detectors(path, detector)
        return read_hit_table(path, units)
    raise CpunetError(
        f"{path}: HDF5 without hits; expected stp (remage), {TABLE} (cpunet simulate) or "
        f"{NTUPLE} (g4simple)"
    )


def _npz(path: Path) -> Steps:
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


def _without_detectors(path: Path, detector: str | None) -> None:
    """Refuse the choice of a detector if all hits belong to a single one."""
    if detector is not None:
        raise CpunetError(
            f"{path}: its hits name no detector to pick {detector} by; leave "
            "--hits-detector out"
        )
