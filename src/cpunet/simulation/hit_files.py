"""Hits of a detector from files: remage, Geant4 and g4simple, archives, and our own."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import item_at, members, opened
from cpunet.pulses.peaks import Peaks, label_peaks
from cpunet.pulses.reading.other_formats import read_arrays
from cpunet.pulses.reading.source import whole_numbers
from cpunet.simulation.hit_steps import NEEDED, StepTable, roles
from cpunet.simulation.hits import HitOptions, Hits
from cpunet.tables import Lines, counted, span

HIT_TABLE = "geds/hits"  # the hits stored with simulated pulses: one row per hit
_NTUPLES, _STEPS = "default_ntuples", "stp"
_G4SIMPLE, _G4SIMPLE_TITLE, _G4SIMPLE_UNITS = "g4sntuple", "steps data", "mm,MeV"
_CSV_MAGIC = b"#class tools::wcsv::ntuple"
# arrays of an NPZ, and the columns that they are
_ARRAYS = {f"{axis}_mm": f"{axis}_in_mm" for axis in "xyz"} | {"edep_keV": "edep_in_keV"}


def read_hits(path: Path | str, options: HitOptions = HitOptions()) -> Hits:
    """Read the energy deposits of one detector.

    Formats: the hits stored with simulated pulses (``geds/hits``), remage LH5 (``stp``
    tables; the origin in ``detector_origins`` is subtracted), HDF5 and CSV ntuples of
    g4simple (MeV and mm), remage and other programs with Geant4, and NPZ with ``x_mm``,
    ``y_mm``, ``z_mm``, ``edep_keV``, ``offsets``. Units are those of the column's attribute or
    name (``edep_in_keV``, ``x [mm]``). Times without a unit are in ns.

    Events are the deposits of a detector with one event number that follow each other within
    10 µs, so that the decays of a chain are events of their own. Where numbering
    starts anew, as in joined jobs, so do events. If a number comes back it is replaced by one
    above the largest.

    Parameters
    ----------
    path
        Path of the file. A step takes some 240 bytes of memory.
    options
        How it is read; `hits_detector` is the name of the table, or the number or name in the
        column that distinguishes detectors (``det_uid``, ``volID``, ``detector``…). An unknown
        or missing unit is an error.

    Raises
    ------
    CpunetError
        If the file cannot be read, has an unknown format, lacks a column, a unit or the
        detector, contains no energy deposit, or has energies of another unit.
    """
    file, chosen = Path(path), options.hits_detector
    with step_tables(file) as detectors:
        names = ", ".join(detectors)
        if chosen is None and len(detectors) > 1:
            raise CpunetError(
                f"{file}: holds detectors {names}; choose one with `hits_detector`"
            )
        if chosen is not None and not names:
            remedy = "leave out `hits_detector`"
            raise CpunetError(f"{file}: its hits name no detector to pick {chosen} by", remedy)
        if chosen is not None and chosen not in detectors:
            raise CpunetError(f"{file}: no detector {chosen}; it holds {names}")
        return detectors[chosen or next(iter(detectors))].hits(options)


def hit_format(path: Path) -> Literal["tables", "stored", "csv", "npz", ""]:
    """Format of a file of hits by its content; `stored` are hits with their pulses."""
    if h5py.is_hdf5(path):
        with opened(path) as file:
            if any(isinstance(file.get(folder), h5py.Group) for folder in (_STEPS, _NTUPLES)):
                return "tables"
            return "stored" if HIT_TABLE in file else ""
    if zipfile.is_zipfile(path):
        with suppress(zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
            return "npz" if {"x_mm.npy", "offsets.npy"} <= {*archive.namelist()} else ""
    try:
        with path.open("rb") as stream:
            return "csv" if stream.read(len(_CSV_MAGIC)) == _CSV_MAGIC else ""
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror})") from error


def holds_hits(path: Path | str) -> bool:
    """Whether a file contains hits rather than pulses.

    Files of simulated pulses that also contain their hits count as files of pulses.
    """
    with suppress(CpunetError):  # the reader of pulses reports the error
        return hit_format(Path(path)) in ("tables", "csv", "npz")
    return False


@contextmanager
def step_tables(path: Path) -> Iterator[dict[str, StepTable]]:
    """Open a file of hits; its tables, by detector, can be read until it is closed.

    Raises
    ------
    CpunetError
        If the file cannot be read, is of no known format or has no table of steps.
    """
    kind = hit_format(path)
    if kind in ("csv", "npz"):
        yield (_csv_table if kind == "csv" else _npz_table)(path).by_detector()
        return
    if not kind:
        raise CpunetError(
            f"{path}: no format of hits; expected LH5 or HDF5 with {_STEPS} (remage), "
            f"{_NTUPLES} (Geant4, g4simple) or {HIT_TABLE} (cpunet simulate), CSV or NPZ"
        )
    with opened(path) as file:
        groups = {"": file[HIT_TABLE]} if kind == "stored" else {}
        for folder in (_STEPS, _NTUPLES):
            if kind == "tables" and (held := item_at(file, folder)) is not None:
                groups |= members(held)
        tables: dict[str, StepTable] = {}
        for name, group in groups.items():
            if isinstance(group, h5py.Group) and {*NEEDED} <= roles(group).keys():
                # the values of a column of Geant4's HDF5 are its pages
                columns = {
                    key: item.get("pages", item) if isinstance(item, h5py.Group) else item
                    for key, item in members(group).items()
                }
                # g4simple writes one table for all detectors
                of = ("", _G4SIMPLE_UNITS) if name == _G4SIMPLE else (name, "")
                tables |= StepTable(path, columns, *of, file).by_detector()
        if not tables:
            raise CpunetError(
                f"{path}: no table of {_STEPS} or {_NTUPLES} has columns for "
                f"{', '.join(NEEDED)}; simulate again and write all steps"
            )
        yield tables


def _npz_table(path: Path) -> StepTable:
    """Arrays with a value per hit. Event i owns rows ``offsets[i]:offsets[i + 1]``."""
    arrays = read_arrays(path)
    needed = [*_ARRAYS, "offsets"]
    if missing := [name for name in needed if name not in arrays]:
        raise CpunetError(f"{path}: no array {missing[0]}; hits need {', '.join(needed)}")
    counts = np.diff(whole_numbers(arrays["offsets"], f"{path}: offsets"))
    if arrays["offsets"][:1].any() or np.any(counts < 0):
        raise CpunetError(f"{path}: offsets do not divide the hits into events")
    columns = {column: arrays[name] for name, column in _ARRAYS.items()}
    return StepTable(path, columns | {"event": np.repeat(np.arange(len(counts)), counts)})


def _csv_table(path: Path) -> StepTable:
    """A CSV ntuple of Geant4, or several in one file; g4simple's is recognised by its title."""
    from pandas import read_csv  # half a second, which other formats do not need

    with path.open(encoding="utf-8", errors="replace") as lines:
        headers = {n: line for n, line in enumerate(lines) if line.startswith("#")}
    first = (line for i, (n, line) in enumerate(headers.items()) if i == n)
    header = [line[1:].strip().partition(" ")[::2] for line in first]
    names = [value.partition(" ")[2] for key, value in header if key == "column"]
    about = {"title": "", "separator": str(ord(","))} | dict(header)
    how: dict[str, Any] = {"sep": chr(int(about["separator"])), "encoding_errors": "replace"}
    try:
        # the columns of one file can be numbers, text or both
        cells = read_csv(path, header=None, skiprows=[*headers], low_memory=False, **how)
    except ValueError as error:
        raise CpunetError(f"{path}: holds no steps ({error}); export again") from error
    if (n := cells.shape[1]) != len(names):
        raise CpunetError(f"{path}: {n} values a line for {len(names)} columns; export again")
    if cells[n - 1].isna().any():
        raise CpunetError(f"{path}: a line is not {n} values; is it cut off?")
    columns = {name: cells[at].to_numpy() for at, name in enumerate(names)}
    g4simple = about["title"] == _G4SIMPLE_TITLE
    return StepTable(path, columns, units=_G4SIMPLE_UNITS if g4simple else "")


def hit_columns(hits: Hits) -> dict[str, tuple[npt.NDArray[Any], str]]:
    """Columns of the table as name → (values, units), in the order of the events.

    Examples
    --------
    >>> hits = Hits.of([[0, 0, 10], [5, 0, 12]], [1000, 592.5], [0, 2], [7])
    >>> columns = hit_columns(hits)
    >>> list(columns), columns["event_number"][0]
    (['event_number', 'x', 'y', 'z', 'edep'], array([7, 7]))
    """
    number = hits.event_number[hits.event_of_hit]
    places = {axis: (hits.position_mm[:, i], "mm") for i, axis in enumerate("xyz")}
    return {"event_number": (number, ""), **places, "edep": (hits.edep_kev, "keV")}


def describe_hits(path: Path, peaks: Peaks, units: str = "") -> dict[str, Lines]:
    """Describe the hits of a file, detector by detector.

    Parameters
    ----------
    path
        A file for which `holds_hits` is true.
    peaks
        Gamma lines whose events are counted.
    units
        Units that the file does not name, as of `HitOptions`.

    Returns
    -------
    dict
        Topics and texts by name of the detector (``""`` if the file names none): hits, their
        energies, gamma lines and extents in the frame of the file; or the reason why they
        cannot be read.
    """
    detectors: dict[str, Lines] = {}
    with step_tables(path) as tables:
        for name, table in tables.items():
            try:
                hits = table.hits(HitOptions(units=units))
            except CpunetError as error:
                detectors[name] = [("hits", str(error).removeprefix(f"{path}: "))]
                continue
            energy, lines = hits.energy_kev, label_peaks(hits.energy_kev, peaks)
            places = {"x": hits.x_mm, "y": hits.y_mm, "z": hits.z_mm, "r": hits.r_mm}
            extents = (f"{axis} {span([x.min(), x.max()], 2)}" for axis, x in places.items())
            detectors[name] = [
                ("hits", f"{len(hits.edep_kev)} of {len(hits)} events"),
                ("energy", f"{span([energy.min(), energy.max()])} keV an event"),
                ("lines", counted({peak: int((lines == peak).sum()) for peak in peaks})),
                ("extents", f"{', '.join(extents)} mm"),
            ]
    return detectors
