"""Open HDF5 files for reading; errors of the library become one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401 - provides the compression filters of LEGEND's files
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError


@contextmanager
def one_line(path: Path) -> Iterator[None]:
    """Errors of the HDF5 library become a `CpunetError` with the name of the file.

    Raises
    ------
    CpunetError
        If the file is missing, truncated or not HDF5.
    """
    try:
        yield
    except CpunetError:
        raise
    except FileNotFoundError:
        raise CpunetError(f"{path}: no such file; check the name") from None
    except (OSError, RuntimeError, ValueError) as error:
        text = " ".join(str(error).split())
        if "file signature not found" in text:
            raise CpunetError(f"{path}: not an HDF5 file; give an LH5 or HDF5 file") from error
        what = "is truncated" if "truncated" in text else f"cannot be read ({text[:160]})"
        raise CpunetError(f"{path}: {what}; copy or write it again") from error


def open_hdf5(path: Path) -> h5py.File:
    """Open an HDF5 file for reading, until the last reference to it is gone; see `one_line`.

    File locking is off, since shared file systems of clusters often lack it.
    """
    with one_line(path):
        return h5py.File(path, "r", locking=False)


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; library errors inside become one line, too."""
    with one_line(path), open_hdf5(path) as file:
        yield file


def item_at(group: h5py.Group, path: str) -> h5py.Group | h5py.Dataset | None:
    """What a path leads to, through links within the file and to others; None if nothing.

    Raises
    ------
    CpunetError
        If a link on the way leads nowhere.
    """
    here = group
    for part in filter(None, path.split("/")):
        link = here.get(part, getlink=True) if isinstance(here, h5py.Group) else None
        if link is None:
            return None
        try:
            here = here[part]
        except (KeyError, OSError, RuntimeError) as error:
            if isinstance(link, h5py.HardLink):
                raise
            file = f"{link.filename}:" if isinstance(link, h5py.ExternalLink) else ""
            why = str(error).strip("'\"").rpartition("(")[2].rstrip(")")
            raise CpunetError(
                f"{group.file.filename}: {part} is a link to {file}{link.path}, where nothing "
                f"can be opened ({why})",
                "put that in its place, or choose another table",
            ) from error
    return here


def members(group: h5py.Group) -> dict[str, h5py.Group | h5py.Dataset]:
    """What a group holds by name, through links; see `item_at`."""
    return {name: item_at(group, name) for name in group}


def lh5_rows(
    item: h5py.Group | h5py.Dataset, start: int, n: int, rows: npt.NDArray[Any] | None = None
) -> Any:
    """Rows of an LH5 object through LEGEND's library, which decodes compressed traces.

    They are those from `start` on, or these of given `rows`.

    Raises
    ------
    ValueError
        If the library cannot decode the object.
    """
    import lh5  # a second, which plain arrays do not need
    from lh5.io.exceptions import LH5DecodeError

    try:
        return lh5.read(item.name, item.file, start_row=start, n_rows=n, idx=rows)
    except LH5DecodeError as error:
        raise ValueError(str(error)) from error


def text_attribute(item: h5py.Group | h5py.Dataset, name: str) -> str:
    """A text attribute, ``""`` if it is missing; some programs write it as an array of one."""
    value = item.attrs.get(name, "")
    if isinstance(value, h5py.Empty):  # as netCDF writes an empty text
        return ""
    value = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def units_of(item: h5py.Group | h5py.Dataset) -> str:
    """Units of an item, ``""`` if it names none."""
    return text_attribute(item, "units") or text_attribute(item, "unit")


def is_column(item: object) -> bool:
    """Whether an object of a file is a one-dimensional array of numbers, or one number."""
    if not isinstance(item, h5py.Dataset) or item.shape is None:  # with a type, without values
        return False
    return item.ndim <= 1 and item.dtype.kind in "iufb"
