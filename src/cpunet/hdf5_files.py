"""Open HDF5 files for reading, and their columns; errors of the library become one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401 - provides the compression filters of LEGEND's files
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.tables import shortened


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; library errors inside become a `CpunetError`.

    File locking is off, since shared file systems of clusters often lack it.

    Raises
    ------
    CpunetError
        If the file is missing, truncated or not HDF5.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
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


def lh5_rows(item: h5py.Group | h5py.Dataset, start: int, n: int) -> Any:
    """Rows of an LH5 object through LEGEND's library, which decodes compressed traces.

    Raises
    ------
    ValueError
        If the library cannot decode the object.
    """
    import lh5  # a second, which plain arrays do not need
    from lh5.io.exceptions import LH5DecodeError

    try:
        return lh5.read(item.name, item.file, start_row=start, n_rows=n)
    except LH5DecodeError as error:
        raise ValueError(str(error)) from error


def text_attribute(item: h5py.Group | h5py.Dataset, name: str) -> str:
    """A text attribute, ``""`` if it is missing; some programs write it as an array of one."""
    value = item.attrs.get(name, "")
    value = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def is_column(item: object) -> bool:
    """Whether an object of a file is a one-dimensional array of numbers, or one number."""
    return isinstance(item, h5py.Dataset) and item.ndim <= 1 and item.dtype.kind in "iufb"


@dataclass(frozen=True)
class Hdf5Column:
    """Dataset of an HDF5 file with one value per event; the file is open only while reading.

    Parameters
    ----------
    path, dataset
        File, and path of the dataset in it.
    units
        The attribute ``units``, empty if there is none.
    size
        Number of values.
    constant
        Whether it is a scalar, which applies to all events.
    first
        Row of the first event.
    """

    path: Path
    dataset: str
    units: str
    size: int
    constant: bool
    first: int = 0

    def __len__(self) -> int:
        return self.size

    def part(self, first: int, size: int) -> Hdf5Column:
        """The rows of some events."""
        return self if self.constant else replace(self, first=first, size=size)

    def read(self, start: int, stop: int) -> npt.NDArray[Any]:
        """Values of the events `start` to `stop` - 1, shape ``(stop - start,)``."""
        with opened(self.path) as file:
            if self.constant:
                return np.full(stop - start, file[self.dataset][()])
            return np.asarray(file[self.dataset][self.first + start : self.first + stop])


def columns_of(path: Path, group: h5py.Group) -> dict[str, Hdf5Column]:
    """Columns of a group: its numeric datasets of one dimension, and its scalars."""
    members = {name: group.get(name) for name in group}
    return {name: _column(path, m) for name, m in members.items() if is_column(m)}


def column_of(path: Path, name: str) -> tuple[Hdf5Column, dict[str, Hdf5Column]]:
    """Return a column of an HDF5 file by its path in the file, and all columns of its group.

    Raises
    ------
    CpunetError
        If there is no such file or column; the message lists the other columns of the group.
    """
    with opened(path) as file:
        found = file.get(name)
        if is_column(found):
            return _column(path, found), columns_of(path, found.parent)
        parent = file.get(name.strip("/").rpartition("/")[0] or "/")
        known = list(columns_of(path, parent)) if isinstance(parent, h5py.Group) else list(file)
    raise CpunetError(f"{path}: no column {name}; there are {shortened(known)}")


def _column(path: Path, dataset: h5py.Dataset) -> Hdf5Column:
    units = text_attribute(dataset, "units")
    return Hdf5Column(path, dataset.name, units, dataset.size, dataset.ndim == 0)
