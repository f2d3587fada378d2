"""One entry point for all formats of hits, recognised by content, and what is in a file."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.pulses.peaks import label_peaks
from cpunet.pulses.reading.arrays import read_arrays
from cpunet.pulses.reading.source import whole_numbers
from cpunet.recipes.schema import PeakConfig
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_steps import (
    Columns,
    Steps,
    choose,
    in_memory,
    require_physics,
    require_some,
    to_hits,
)
from cpunet.simulation.hit_tables import (
    NTUPLES,
    STEPS,
    Table,
    csv_detectors,
    detectors_of,
    holds_tables,
    parts_of,
    read_csv,
    read_table,
    table_of,
)
from cpunet.simulation.hits import HitOptions, Hits
from cpunet.tables import counted, span

HIT_TABLE = "geds/hits"  # the hits stored with simulated pulses: one row per hit
_EVENTS = "geds/sim/event_number"
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ZIP_MAGIC = b"PK"
_CSV_MAGIC = b"#class tools::wcsv::ntuple"
# More hits outside the crystal are those of another frame, or of another detector.
_MISPLACED_PERCENT = 1.0
# arrays of an NPZ beside the offsets, as columns of steps
_ARRAYS = {f"{axis}_mm": (axis, "mm") for axis in "xyz"} | {"edep_keV": ("edep", "keV")}


def read_hits(path: Path | str, options: HitOptions = HitOptions()) -> Hits:
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
    options
        How it is read; `hits_detector` is one of `hit_detectors`: the name of the table, or
        the number or name in the column that tells detectors apart (``det_uid``, ``volID``,
        ``detector``…). An unknown or missing unit is an error.

    Raises
    ------
    CpunetError
        If the file cannot be read, has an unknown format, lacks a column, a unit or the
        detector, contains no energy deposit, or has energies of another unit.
    """
    file = Path(path)
    hits = to_hits(file, _steps(file, options), options)
    require_some(file, hits.n_events)
    require_physics(file, hits.energy_kev)
    return hits


def hit_parts(
    path: Path | str, options: HitOptions = HitOptions()
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
    table = table_of(file, options.hits_detector) if _kind(file) == "tables" else None
    divided = parts_of(file, table) if table else None
    if table is None or divided is None or len(divided[0]) < 2:
        whole = read_hits(file, options)
        return lambda: iter([whole])
    parts, largest = divided

    def read() -> Iterator[Hits]:
        free, energies = largest + 1, []
        for rows in parts:
            hits = to_hits(file, read_table(file, table, options, rows), options, free)
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
    with suppress(CpunetError, zipfile.BadZipFile):  # the reader of pulses reports the error
        kind = _kind(file)
        if kind == "npz":
            with zipfile.ZipFile(file) as archive:
                return {"x_mm.npy", "offsets.npy"} <= set(archive.namelist())
        return kind in ("tables", "csv")
    return False


def hit_detectors(path: Path | str) -> list[str]:
    """Names of the detectors of a file; empty if it names none."""
    file = Path(path)
    if (kind := _kind(file)) == "csv":
        return csv_detectors(file)
    return list(detectors_of(file)) if kind == "tables" else []


def _kind(path: Path) -> Literal["tables", "stored", "csv", "npz", "other"]:
    """Format of a file by its content; `stored` are hits beside their pulses."""
    try:
        with path.open("rb") as stream:
            start = stream.read(len(_CSV_MAGIC))
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror})") from error
    if start.startswith(_HDF5_MAGIC):
        with opened(path) as file:
            return (
                "tables" if holds_tables(file) else "stored" if HIT_TABLE in file else "other"
            )
    if start.startswith(_ZIP_MAGIC):
        return "npz"
    return "csv" if start == _CSV_MAGIC else "other"


def _steps(path: Path, options: HitOptions) -> Steps:
    detector, kind = options.hits_detector, _kind(path)
    if kind == "csv":
        return read_csv(path, options)
    if kind == "tables":
        return read_table(path, table_of(path, detector), options)
    choose(path, [], detector)
    if kind == "other":
        raise CpunetError(
            f"{path}: no known format of hits; expected LH5 or HDF5 with {STEPS} (remage), "
            f"{NTUPLES} (Geant4, g4simple) or {HIT_TABLE} (cpunet simulate), CSV or NPZ"
        )
    return _npz(path) if kind == "npz" else _stored(path)


def _npz(path: Path) -> Steps:
    """Read the steps of an archive. Event i owns rows ``offsets[i]:offsets[i + 1]``."""
    arrays = read_arrays(path)
    needed = [*_ARRAYS, "offsets"]
    if missing := [name for name in needed if name not in arrays]:
        raise CpunetError(f"{path}: no array {missing[0]}; hits need {', '.join(needed)}")
    offsets = whole_numbers(arrays["offsets"], f"{path}: offsets")
    counts = np.diff(offsets)
    if offsets.ndim != 1 or not len(offsets) or offsets[0] or np.any(counts < 0):
        raise CpunetError(f"{path}: offsets do not divide the hits into events")
    columns = {"event": in_memory(np.repeat(np.arange(len(counts)), counts))}
    for name, (role, unit) in _ARRAYS.items():
        columns[role] = in_memory(arrays[name], unit)
    return Columns(path, columns).steps(HitOptions())


def hit_columns(hits: Hits) -> dict[str, tuple[npt.NDArray[Any], str]]:
    """Columns of the table as name → (values, units), in the order of the events.

    Examples
    --------
    >>> hits = Hits.of([[0, 0, 10], [5, 0, 12]], [1000, 592.5], [0, 2], [7])
    >>> columns = hit_columns(hits)
    >>> list(columns), columns["event_number"][0]
    (['event_number', 'x', 'y', 'z', 'edep'], array([7, 7]))
    """
    return {
        "event_number": (np.repeat(hits.event_number, np.diff(hits.offsets)), ""),
        "x": (hits.x_mm, "mm"),
        "y": (hits.y_mm, "mm"),
        "z": (hits.z_mm, "mm"),
        "edep": (hits.edep_kev, "keV"),
    }


def _stored(path: Path) -> Steps:
    """Steps beside their pulses, in the frame of the crystal in which they were written."""
    steps = read_table(path, Table(HIT_TABLE, None), HitOptions())
    with opened(path) as file:
        events = np.asarray(file[_EVENTS][()]) if _EVENTS in file else np.empty(0, np.int64)
    without = ~np.isin(events, steps.event)
    if without.any():
        raise CpunetError(
            f"{path}: {HIT_TABLE} has no hit of event {events[without][0]}; simulate it again"
        )
    return steps


@dataclass(frozen=True)
class HitsInfo:
    """What is known of the hits of one detector.

    Parameters
    ----------
    events, hits
        Their numbers.
    energy_kev
        Lowest and highest energy of an event in keV.
    extents_mm
        Lowest and highest x, y, z and r in the frame of the file less a known origin.
    peaks
        Number of events in each gamma line, by the energy deposited.
    crystal
        Crystal in which the hits should lie, if one was given.
    outside_percent
        Share of the hits outside it.
    """

    events: int
    hits: int
    energy_kev: list[float]
    extents_mm: dict[str, list[float]]
    peaks: dict[str, int]
    crystal: Detector | None
    outside_percent: float

    @property
    def lines(self) -> list[tuple[str, str]]:
        """Names and texts."""
        extents = ", ".join(f"{axis} {span(ends, 2)}" for axis, ends in self.extents_mm.items())
        lines = [
            ("hits", f"{self.hits} of {self.events} events"),
            ("energy", f"{span(self.energy_kev)} keV an event"),
            ("lines", counted(self.peaks)),
            ("extents", f"{extents} mm"),
        ]
        if (crystal := self.crystal) is not None:
            size = f"radius {crystal.crystal_radius:g} mm, z 0 to {crystal.crystal_length:g} mm"
            misplaced = self.outside_percent > _MISPLACED_PERCENT
            remedy = "; check `origin`, `flip_z` and the dimensions" if misplaced else ""
            lines += [
                ("crystal", f"{crystal.name}, {size}"),
                ("outside", f"{self.outside_percent:.2f} % of the hits{remedy}"),
            ]
        return lines


def describe_hits(
    path: Path,
    options: HitOptions,
    peaks: Mapping[str, PeakConfig],
    crystal: Detector | None = None,
) -> dict[str, HitsInfo | str]:
    """Describe the hits of a file, detector by detector.

    Parameters
    ----------
    path
        A file for which `holds_hits` is true.
    options
        How it is read; all detectors if none is chosen.
    peaks
        Gamma lines whose events are counted.
    crystal
        Crystal in which the hits should lie.

    Returns
    -------
    dict
        By name of the detector (``""`` if the file names none); or the reason why its hits
        cannot be read.
    """
    found: dict[str, HitsInfo | str] = {}
    names: list[str | None] = [options.hits_detector]
    if options.hits_detector is None:
        names = [*hit_detectors(path)] or names
    for name in names:
        as_in_file = replace(options, hits_detector=name, origin=(0, 0, 0), flip_z=False)
        try:
            hits = read_hits(path, as_in_file)
        except CpunetError as error:
            found[name or ""] = str(error).removeprefix(f"{path}: ")
            continue
        places = {"x": hits.x_mm, "y": hits.y_mm, "z": hits.z_mm}
        places["r"] = np.hypot(hits.x_mm, hits.y_mm)
        lines = label_peaks(hits.energy_kev, peaks)
        x, y, z = options.to_crystal(hits.position_mm).T
        inside = np.ones(len(x), bool) if crystal is None else crystal.inside(np.hypot(x, y), z)
        found[name or ""] = HitsInfo(
            events=hits.n_events,
            hits=len(x),
            energy_kev=_ends(hits.energy_kev),
            extents_mm={axis: _ends(values) for axis, values in places.items()},
            peaks={peak: int((lines == peak).sum()) for peak in peaks},
            crystal=crystal,
            outside_percent=100 * float(np.mean(~inside)),
        )
    return found


def _ends(values: npt.NDArray[np.float64]) -> list[float]:
    return [float(values.min()), float(values.max())]
