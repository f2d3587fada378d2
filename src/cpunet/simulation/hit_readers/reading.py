"""One entry point for all formats of hits, recognised by the content of the file."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.pulses.reading.arrays import read_arrays
from cpunet.simulation.hit_readers.csv_ntuple import csv_detectors, read_csv
from cpunet.simulation.hit_readers.hit_table import TABLE, read_hit_table
from cpunet.simulation.hit_readers.steps import (
    ReadHits,
    Steps,
    Transform,
    Units,
    require_physics,
    require_some,
    to_hits,
    whole_numbers,
)
from cpunet.simulation.hit_readers.tables import (
    NTUPLES,
    STEPS,
    detectors_of,
    holds_tables,
    largest_number,
    parts_of,
    read_table,
    table_of,
)
from cpunet.simulation.hits import Hits

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ZIP_MAGIC = b"PK"
_CSV_MAGIC = b"#class tools::wcsv::ntuple"
_AS_IN_THE_FILE = Transform()
# The interval after which charge is another event: that of remage
TIME_WINDOW_US = 10.0
_NEEDED = ("x_mm", "y_mm", "z_mm", "edep_keV", "offsets")  # arrays of an NPZ


def read_hits(
    path: Path | str,
    *,
    detector: str | None = None,
    transform: Transform = _AS_IN_THE_FILE,
    length_unit: str | None = None,
    energy_unit: str | None = None,
    time_window_us: float = TIME_WINDOW_US,
) -> ReadHits:
    """Read the energy deposits of one detector.

    Formats: the hits stored with simulated pulses (``geds/hits``), remage LH5 (``stp``
    tables; the origin in ``detector_origins`` is subtracted), HDF5 and CSV ntuples of
    g4simple (MeV and mm), remage and other programs with Geant4, and NPZ with ``x_mm``,
    ``y_mm``, ``z_mm``, ``edep_keV``, ``offsets``. Units are those of the column's attribute or
    name (``edep_in_keV``, ``x [mm]``). Times without a unit are in ns.

    Events are the deposits of a detector with one event number that follow each other within
    `time_window_us`, so that the decays of a chain are events of their own. Where numbering
    starts anew, as in joined jobs, so do events. If a number comes back it is replaced by one
    above the largest.

    Parameters
    ----------
    path
        Path of the file.
    detector
        Detector to read, one of `hit_detectors`: the name of the table, or the number or name
        in the column that tells detectors apart (``det_uid``, ``volID``, ``detector``…). Not
        needed if there is only one.
    transform
        Transformation from the frame of the file to that of the crystal (z = 0 at the point
        contact).
    length_unit, energy_unit
        Units of columns that name none. An unknown or missing unit is an error.
    time_window_us
        Longest interval in us between deposits of an event; that of remage by default.

    Raises
    ------
    CpunetError
        If the file cannot be read, has an unknown format, lacks a column, a unit or the
        detector, contains no energy deposit, or has energies of another unit.
    """
    file = Path(path)
    steps = _steps(file, detector, Units(length_unit, energy_unit))
    found = to_hits(file, steps, transform, time_window_us)
    require_some(file, found.hits.n_events)
    require_physics(file, found.hits.energy_kev)
    return found


def hit_parts(
    path: Path | str,
    *,
    detector: str | None = None,
    transform: Transform = _AS_IN_THE_FILE,
    length_unit: str | None = None,
    energy_unit: str | None = None,
    time_window_us: float = TIME_WINDOW_US,
) -> Callable[[], Iterator[Hits]]:
    """Like `read_hits`, but in parts if possible, so that memory does not grow with the file.

    Tables in HDF5 are read in parts, unless the rows of an event are not adjacent or several
    detectors share the table. All other files are read once and kept in memory.

    Returns
    -------
    callable
        Returns an iterator over the parts, from the first one, each time it is called.
    """
    file = Path(path)
    table = table_of(file, detector) if _has_tables(file) else None
    parts = parts_of(file, table) if table else None
    if table is None or parts is None or len(parts) < 2:
        whole = read_hits(
            file,
            detector=detector,
            transform=transform,
            length_unit=length_unit,
            energy_unit=energy_unit,
            time_window_us=time_window_us,
        ).hits
        return lambda: iter([whole])
    units, largest = Units(length_unit, energy_unit), largest_number(file, table)

    def read() -> Iterator[Hits]:
        free, energies = largest + 1, []
        for rows in parts:
            steps = read_table(file, table, units, rows)
            hits = to_hits(file, steps, transform, time_window_us, free).hits
            free += int((hits.event_number >= free).sum())
            energies.append(hits.energy_kev)
            yield hits
        require_physics(file, np.concatenate(energies))

    return read


def holds_hits(path: Path | str) -> bool:
    """Whether a file contains hits rather than pulses.

    Files of simulated pulses that also contain their hits count as files of pulses.
    """
    file = Path(path)
    start = _start(file)
    if start.startswith(_HDF5_MAGIC):
        with opened(file) as content:
            return holds_tables(content)
    if start.startswith(_ZIP_MAGIC):
        with suppress(zipfile.BadZipFile), zipfile.ZipFile(file) as archive:
            return {"x_mm.npy", "offsets.npy"} <= set(archive.namelist())
        return False  # the reader of pulses reports the error
    return start == _CSV_MAGIC


def hit_detectors(path: Path | str) -> list[str]:
    """Names of the detectors of a file; empty if it names none."""
    file = Path(path)
    if _start(file) == _CSV_MAGIC:
        return csv_detectors(file)
    return list(detectors_of(file)) if _has_tables(file) else []


def _start(path: Path) -> bytes:
    """First bytes of a file; none if it cannot be read, which its reader reports."""
    try:
        with path.open("rb") as stream:
            return stream.read(len(_CSV_MAGIC))
    except OSError:
        return b""


def _has_tables(path: Path) -> bool:
    if not _start(path).startswith(_HDF5_MAGIC):
        return False
    with opened(path) as file:
        return holds_tables(file)


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
        is_kept = TABLE in file
    if _has_tables(path):
        return read_table(path, table_of(path, detector), units)
    if is_kept:
        _without_detectors(path, detector)
        return read_hit_table(path, units)
    raise CpunetError(
        f"{path}: HDF5 without hits; expected {STEPS} (remage), {TABLE} (cpunet simulate) or "
        f"{NTUPLES} (Geant4, g4simple)"
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
            "`hits_detector` out"
        )
