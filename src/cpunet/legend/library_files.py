"""Pulse-shape libraries in files: those of charge checked, those of currents merged.

Simulate the library of pulse shapes that production simulations look up.

A library holds the charge pulse of every place in a detector.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened, units_of
from cpunet.outputs import refuse_existing
from cpunet.progress import stage
from cpunet.pulses.writing import written_hdf5
from cpunet.settings import Set, read_values
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import detector_and_settings
from cpunet.simulation.simulator import Simulator
from cpunet.training.run import Run
from cpunet.units import factor, unit_names

PERIOD_NS = 1.0
LARGEST_MM = 500.0  # upper limit of coordinates in a crystal
WAVEFORM = re.compile(r"waveform_\d{3}_deg")

Values = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class IdealLibrary:
    """Templates of charge of a detector in a file, sampled every nanosecond.

    Attributes
    ----------
    where
        File and group, for messages.
    path
        Path of the group, the detector's name.
    r_mm, z_mm
        Grid points.
    angles
        Azimuths such as ``"000_deg"``, ascending.
    """

    where: str
    path: str
    r_mm: Values
    z_mm: Values
    angles: tuple[str, ...]

    @classmethod
    def of(cls, file: h5py.File, path: str, source: Path) -> Self:
        """Read the axes of a library.

        Raises
        ------
        CpunetError
            If the library does not follow the schema, or its templates are not sampled every
            nanosecond.
        """
        where = f"{source}: {path or '/'}"
        if not path:
            raise CpunetError(
                f"{source}: the library stands at the top of the file; production finds it "
                "under the detector's name: write it into a group of this name"
            )
        group = file[path]
        if missing := sorted({"r", "z", "dt"} - set(group)):
            raise CpunetError(
                f"{where}: no {missing[0]} with the waveforms; complete the library"
            )
        r_mm, z_mm = (_axis(group[name], where, name) for name in ("r", "z"))
        dt, units = group["dt"], units_of(group["dt"])
        ns_per_unit = factor(units, "ns") or np.nan
        dt_ns = ns_per_unit * dt[()].item() if is_column(dt) else np.nan
        if not np.isclose(dt_ns, PERIOD_NS):
            raise CpunetError(
                f"{where}: sampled every {dt_ns:g} ns (dt in {str(units)!r}), production reads "
                "templates of 1 ns; make the library with a period of 1 ns"
            )
        names = sorted(filter(WAVEFORM.fullmatch, group))
        for name in names:
            values = group[name]
            numbers = isinstance(values, h5py.Dataset) and values.dtype.kind in "iuf"
            shape: tuple[int, ...] = values.shape if numbers else ()
            if len(shape) != 3 or shape[:2] != (len(r_mm), len(z_mm)) or shape[2] < 2:
                raise CpunetError(
                    f"{where}/{name}: shape {shape} with r and z of {len(r_mm)} and "
                    f"{len(z_mm)}; expected numbers of shape (r, z, samples)"
                )
        angles = tuple(name.removeprefix("waveform_") for name in names)
        return cls(where, path, r_mm, z_mm, angles)

    @property
    def n_templates(self) -> int:
        """Number of grid points times angles."""
        return len(self.r_mm) * len(self.z_mm) * len(self.angles)


def _axis(column: h5py.Dataset, where: str, name: str) -> Values:
    if not is_column(column) or column.ndim != 1:
        raise CpunetError(f"{where}: {name} is no column of numbers; complete the library")
    units = units_of(column)
    if (mm_per_unit := factor(units, "mm")) is None:
        raise CpunetError(
            f"{where}: {name} is in {units!r}; expected one of {unit_names('mm')}"
        )
    values = np.asarray(column[()], np.float64) * mm_per_unit
    if len(values) < 2 or not (np.isfinite(values).all() and (np.diff(values) > 0).all()):
        raise CpunetError(
            f"{where}: {name} does not ascend from node to node; write the library again"
        )
    if np.abs(values).max() > LARGEST_MM:
        raise CpunetError(
            f"{where}: {name} reaches {np.abs(values).max():g} mm, beyond any crystal; are its "
            f"units ({units}) right?"
        )
    return values


def chosen_libraries(
    file: h5py.File, source: Path, wanted: Sequence[str], name: str | None
) -> list[str]:
    """Paths of the libraries to translate.

    Parameters
    ----------
    file, source
        The file and its name.
    wanted
        Names given by the user, or an empty sequence.
    name
        Detector that the run was trained with; None if unknown.

    Raises
    ------
    CpunetError
        If there is no library, a named one is missing, or none belongs to the detector of the
        run.
    """
    names = _libraries(file)
    if not names:
        raise CpunetError(
            f"{source}: no pulse-shape library (no array waveform_000_deg or the like); give a "
            "struct{r, z, dt, t0, waveform_000_deg}"
        )
    held = ", ".join(path or "/" for path in names)
    for name in wanted:
        if name not in names:
            raise CpunetError(f"{source}: no library of {name}; the file has {held}")
    if wanted:
        return list(dict.fromkeys(wanted))
    if name is None:
        return names
    if name not in names:
        raise CpunetError(
            f"{source}: a library of {held}, but the run was trained with a simulation of "
            f"{name}; give the library of {name}, or `detector` {names[0]} to use this one "
            "all the same"
        )
    return [name]


def _libraries(file: h5py.File) -> list[str]:
    """Paths of the groups that hold templates."""
    groups: set[str] = set()

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        group, _, last = name.rpartition("/")
        if isinstance(item, h5py.Dataset) and WAVEFORM.fullmatch(last):
            groups.add(group)

    file.visititems(visit)
    return sorted(groups)


def known_detector(run: Run) -> str | None:
    """Name of the detector whose simulation a run was trained with; None if unknown."""
    if run.folder is not None:
        with suppress(CpunetError):  # only a calibrated run has it
            if name := read_values(run.folder / "detector.yaml").get("name"):
                return str(name)
    return run.sim.detector


def require_complete(
    inside: Mapping[str, npt.NDArray[np.bool_]], library: IdealLibrary
) -> None:
    """Raise an error if a library lacks whole rows of grid points between others.

    Raises
    ------
    CpunetError
        If an azimuth has no template, or a row of r or of z has none although rows on both
        sides of it have.
    """
    for angle, mask in inside.items():
        if not mask.any():
            raise CpunetError(
                f"{library.where}: no template of {angle} can be translated; simulate this "
                "azimuth again, or leave it out"
            )
        for name, axis, rows in (
            ("r", library.r_mm, mask.any(axis=1)),
            ("z", library.z_mm, mask.any(axis=0)),
        ):
            held = np.flatnonzero(rows)
            missing = np.setdiff1d(np.arange(held[0], held[-1]), held)
            if len(missing):
                raise CpunetError(
                    f"{library.where}: {len(missing)} rows of {angle} are NaN between others, "
                    f"the first at {name} {axis[missing[0]]:g} mm; simulate these places again"
                )


def put(group: h5py.Group, name: str, values: npt.ArrayLike, units: str) -> None:
    """Store a number or an array with LH5 attributes, templates in chunks of a row of r."""
    values = np.asarray(values)
    large = {"chunks": (1, *values.shape[1:]), "compression": 1, "shuffle": True}
    made = group.create_dataset(name, data=values, **(large if values.ndim > 1 else {}))
    kind = f"array<{values.ndim}>{{real}}" if values.ndim else "real"
    made.attrs.update({"datatype": kind, "units": units})


def describe(group: h5py.Group) -> None:
    """Add LH5's attribute to a complete library and to every level above it."""
    while group.name != "/":
        group.attrs["datatype"] = f"struct{{{','.join(sorted(group))}}}"
        group = group.parent


def merge_libraries(
    sources: Sequence[str | Path], out: str | Path, *, force: bool = False
) -> list[str]:
    """Copy current libraries of several detectors into one file, as in production.

    Parameters
    ----------
    sources
        Files that `cpunet library translate` made, each of some detectors.
    out
        File to write.
    force
        Whether to replace an existing file.

    Returns
    -------
    list of str
        Names of the detectors.

    Raises
    ------
    CpunetError
        If a file contains no current library, or two libraries belong to one detector.
    """
    paths, out = [*map(Path, sources)], Path(out)
    refuse_existing(out, *paths, force=force)
    first: dict[str, Path] = {}
    with written_hdf5(out) as (made, _):
        for path in paths:
            with opened(path) as file:
                names = [
                    name  # times of currents are relative to their maxima
                    for name in _libraries(file)
                    if name
                    and {"r", "z", "dt", "t0"} <= file[name].keys()
                    and file[name]["t0"][()] < 0
                ]
                if not names:
                    raise CpunetError(
                        f"{path}: no current library; make it with `cpunet library translate`"
                    )
                for name in names:
                    if name in first:
                        raise CpunetError(
                            f"{path}: a second library of {name}, which {first[name]} has "
                            "already; give one of each detector"
                        )
                    first[name] = path
                    file.copy(name, made, name)
                    describe(made[name].parent)
    return sorted(first)


LENGTH_NS = 5000.0  # as in libraries of SolidStateDetectors.jl
ENERGY_KEV = 1000.0  # of each hit; matters only with self-repulsion
ANGLES_DEG = (0, 45)  # <100> and <110>; reboost interpolates between them


@dataclass
class MadeLibrary:
    """A library of charge pulses that was made.

    Parameters
    ----------
    path
        The file.
    templates
        Number of grid points times angles.
    written, outside, late
        Numbers of those with a template, without a signal, and whose charge is not collected
        within the record.
    """

    path: Path
    templates: int = 0
    written: int = 0
    outside: int = 0
    late: int = 0

    def __str__(self) -> str:
        return (
            f"{self.path}: {self.written} of {self.templates} places have a template; "
            f"{self.outside} give no signal, {self.late} are not collected in time"
        )


def make_library(
    detector: str | Path | Detector,
    out: str | Path,
    *,
    grid_mm: float = 1.0,
    settings: Set = (),
    force: bool = False,
) -> MadeLibrary:
    """Simulate the charge pulse of every place in a detector.

    The LH5 file holds ``struct{r, z, dt, t0, waveform_000_deg, drift_time_000_deg, ...}``
    under the detector's name: r and z in mm from the centre of the point contact, times in
    ns after the charge is created, pulses of unit charge as float32 arrays of shape
    (r, z, samples).  The drift times of the format are the times until all charge is
    collected, `EventPulses.collection_time_ns`.  Grid points without a signal, and those
    whose charge is not collected within the record, are NaN.

    Parameters
    ----------
    detector
        icpc, bege, ppc, a YAML file, a siggen configuration or LEGEND metadata.
    out
        LH5 file to write.
    grid_mm
        Spacing of the places in r and z.
    settings
        Override a value of the detector or the simulation, bias_V=3500, or all those in a YAML
        file (repeatable); templates have length_ns=5000 without. Their period is 1 ns, as
        production reads them.
    force
        Replace an existing file.

    Returns
    -------
    MadeLibrary
        The file, with numbers of its templates.

    Raises
    ------
    CpunetError
        If the detector is not depleted, no grid point has a template, or the file cannot be
        written.

    Examples
    --------
    cpunet library make --detector icpc --out psl.lh5

    cpunet library make --detector icpc --out psl.lh5 --grid-mm 0.5 --set length_ns=3000
    """
    out = Path(out)
    words = () if isinstance(settings, Mapping) else settings
    inputs = [given for given in (detector, *words) if isinstance(given, str | Path)]
    refuse_existing(out, *inputs, force=force)
    detector, wanted = detector_and_settings(
        detector, settings, dt_ns=PERIOD_NS, length_ns=LENGTH_NS
    )
    if wanted.dt_ns != PERIOD_NS:
        raise CpunetError(
            f"settings: dt_ns = {wanted.dt_ns:g}: templates are sampled every nanosecond, as "
            "production reads them; leave dt_ns out"
        )
    if not (math.isfinite(grid_mm) and grid_mm > 0):
        raise CpunetError(f"`grid_mm` is {grid_mm}; expected more than 0")
    simulator = Simulator(detector, wanted)
    r_mm, z_mm = (
        np.arange(int(axis[-1] / grid_mm + 1e-6) + 1) * grid_mm
        for axis in (simulator.fields.r_mm, simulator.fields.z_mm)
    )
    counts = MadeLibrary(out, templates=len(ANGLES_DEG) * len(r_mm) * len(z_mm))
    shape = (len(r_mm), len(z_mm))
    with written_hdf5(out) as (made, _), stage("Templates", counts.templates) as bar:
        library = made.create_group(detector.name or "detector")
        put(library, "r", r_mm, "mm")
        put(library, "z", z_mm, "mm")
        put(library, "dt", wanted.dt_ns, "ns")
        put(library, "t0", 0.0, "ns")
        waveforms = np.empty((*shape, wanted.n_samples), np.float32)
        drift_times = np.empty(shape)
        for angle_deg in ANGLES_DEG:
            waveforms.fill(np.nan)
            drift_times.fill(np.nan)
            phi = math.radians(angle_deg)
            for i, r in enumerate(r_mm):
                x, y = r * math.cos(phi), r * math.sin(phi)
                signals = simulator.signals(x, y, z_mm, ENERGY_KEV)
                good = signals.valid & signals.collected
                waveforms[i, good] = signals.waveforms[good]
                drift_times[i, good] = signals.collection_time_ns[good]
                counts.written += int(good.sum())
                counts.outside += int((~signals.valid).sum())
                counts.late += int((signals.valid & ~signals.collected).sum())
                bar.update(len(z_mm))
            put(library, f"waveform_{angle_deg:03d}_deg", waveforms, "")
            put(library, f"drift_time_{angle_deg:03d}_deg", drift_times, "ns")
        describe(library)
        if not counts.written:
            raise CpunetError(f"{counts}; give a finer grid or longer records")
    return counts
