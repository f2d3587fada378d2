"""Check pulse-shape libraries in files."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, text_attribute
from cpunet.pulses.reading.energies import TIME_UNITS

WAVEFORM = re.compile(r"waveform_\d{3}_deg")
# Templates of charge end near their maximum; templates of current do not.
_MIN_END = 0.5


def libraries(file: h5py.File, source: Path) -> list[str]:
    """Paths of all groups with templates.

    Raises
    ------
    CpunetError
        If there is none.
    """
    found: set[str] = set()

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        group, _, last = name.rpartition("/")
        if isinstance(item, h5py.Dataset) and WAVEFORM.fullmatch(last):
            found.add(group)

    file.visititems(visit)
    if not found:
        raise CpunetError(
            f"{source}: no pulse-shape library (no array waveform_000_deg or the like); give a "
            "struct{r, z, dt, t0, waveform_000_deg}"
        )
    return sorted(found)


def n_templates(file: h5py.File, path: str, source: Path) -> int:
    """Number of templates; raise an error if the library does not follow the schema."""
    library = file[path or "/"]
    where = f"{source}: {path or '/'}"
    if missing := sorted({"r", "z", "dt"} - set(library)):
        raise CpunetError(
            f"{where}: no {missing[0]} beside the waveforms; complete the library"
        )
    for name in ("r", "z"):
        if not is_column(library[name]) or library[name].ndim != 1 or not len(library[name]):
            raise CpunetError(f"{where}: {name} is no column of numbers; complete the library")
    total = 0
    for name in filter(WAVEFORM.fullmatch, library):
        if not isinstance(library[name], h5py.Dataset):
            raise CpunetError(f"{where}/{name}: is no array; complete the library")
        shape = library[name].shape
        expected = (len(library["r"]), len(library["z"]))
        if library[name].dtype.kind not in "iuf":
            raise CpunetError(f"{where}/{name}: is of {library[name].dtype}; give numbers")
        if len(shape) != 3 or shape[:2] != expected or shape[2] < 2:
            raise CpunetError(
                f"{where}/{name}: shape {shape} beside r and z of {expected}; expected "
                "(r, z, samples)"
            )
        total += shape[0] * shape[1]
    sampling_period_ns(library, where)
    return total


def sampling_period_ns(library: h5py.Group, where: str) -> float:
    """Sampling period of a library's templates in ns."""
    dt = library["dt"]
    if not is_column(dt) or dt.size != 1:
        raise CpunetError(f"{where}: dt is no number; complete the library")
    units = text_attribute(dt, "units")
    if units not in TIME_UNITS:
        raise CpunetError(
            f"{where}: dt is in {str(units)!r}; known units are {', '.join(TIME_UNITS)}"
        )
    value = number(dt) * TIME_UNITS[units]
    if not 1e-3 <= value <= 1e9:
        raise CpunetError(f"{where}: dt is {value:g} ns; expected 0.001 to 1e9")
    return value


def number(item: h5py.Dataset) -> float:
    """The value of a number, which may be stored as a column with one row."""
    return float(np.asarray(item[()]).reshape(-1)[0])


def n_not_ending(templates: npt.NDArray[np.floating]) -> int:
    """Number of templates that end below half of their height, as those of current do."""
    return int((templates[:, -1] < _MIN_END * np.abs(templates).max(axis=1)).sum())


def require_charge(where: str, n: int, moving: int, not_ending: int) -> None:
    """Raise an error if none of `n` templates has a signal, or most are no charge pulses.

    Parameters
    ----------
    where
        File, and library in it, for the message.
    n, moving, not_ending
        Numbers of templates, of those with a translated signal, and among these of those
        that end low (`n_not_ending`).
    """
    if not moving:
        raise CpunetError(
            f"{where}: none of {n} templates can be translated; are they charge pulses?"
        )
    if 2 * not_ending > moving:
        raise CpunetError(
            f"{where}: {not_ending} of {moving} templates end below half of their maximum: "
            "these are currents, of negative sign, or behind electronics already; give the "
            "library of charge pulses"
        )
