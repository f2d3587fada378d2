"""Check and copy pulse-shape libraries in files."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, require_stored, text_attribute
from cpunet.machine_memory import require_memory
from cpunet.pulses.reading.columns import TIME_UNITS
from cpunet.pulses.reading.source import MAX_SAMPLES

WAVEFORM = re.compile(r"waveform_\d{3}_deg")
# Templates of charge end near their maximum; templates of current do not.
_MIN_END = 0.5


def require_whole(group: h5py.Group, source: Path, seen: set[tuple[int, int]]) -> None:
    """Raise an error for broken or repeated links, and for arrays without stored values."""
    info = h5py.h5o.get_info(group.id)
    if (info.fileno, info.addr) in seen:
        raise CpunetError(f"{source}: {group.name} is linked twice; write the library again")
    seen.add((info.fileno, info.addr))
    for name in group:
        item = group.get(name)
        if item is None:
            raise CpunetError(f"{source}: {group.name}: link {name} leads nowhere; remove it")
        if isinstance(item, h5py.Group):
            require_whole(item, source, seen)
        elif isinstance(item, h5py.Dataset):
            require_stored(source, item)


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
        if len(shape) != 3 or shape[:2] != expected or not 2 <= shape[2] <= MAX_SAMPLES:
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


def copy_values(item: h5py.Dataset, made: h5py.Group, name: str) -> None:
    """Copy a dataset by value, since HDF5's own copy crashes on damaged datasets."""
    if not isinstance(item, h5py.Dataset):  # an array without its shape looks like a type
        raise CpunetError(f"{item.file.filename}: '{name}' is no array; write it again")
    require_memory(item.nbytes, f"{item.file.filename}: '{name}'", "give a smaller library")
    try:
        values = item[()]
    except OSError as error:
        said = " ".join(str(error).split())
        raise CpunetError(
            f"{item.file.filename}: '{name}' cannot be read ({said}); write it again"
        ) from error
    stored = item.id.get_create_plist()  # includes the filters, also those of plugins
    if stored.get_external_count() or item.is_virtual:
        copy = made.create_dataset(name, data=values)
    else:
        space, kind = item.id.get_space(), item.id.get_type()
        h5py.h5d.create(made.id, name.encode(), kind, space, dcpl=stored)
        copy = made[name]
        copy[()] = values
    copy.attrs.update(item.attrs)


def copy_group(given: h5py.Group, made: h5py.Group) -> None:
    """Copy a group and everything in it by value; see `copy_values`."""
    made.attrs.update(given.attrs)
    for name, item in given.items():
        if isinstance(item, h5py.Group):
            copy_group(item, made.create_group(name))
        else:
            copy_values(item, made, name)
