"""HDF5 files opened for reading, their errors in one line, and their columns."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

# The package brings the compression filters of LEGEND's files with it.
from lh5.io.exceptions import LH5DecodeError

from cpunet.errors import CpunetError
from cpunet.pulses.reading.columns import shortened


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; library errors inside become a `CpunetError`.

    File locking is off, as shared file systems of clusters often lack it.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except FileNotFoundError:
        raise CpunetError(f"{path}: no such file; check the name") from None
    except (OSError, RuntimeError, ValueError, LH5DecodeError) as error:
        if "truncated" in str(error):
            what = "is truncated"
        elif "file signature not found" in str(error):
            raise CpunetError(f"{path}: not an HDF5 file; give an LH5 or HDF5 file") from error
        else:
            what = f"cannot be read ({_one_line(error)})"
        raise CpunetError(f"{path}: {what}; copy or write it again") from error


@dataclass(frozen=True)
class Hdf5Column:
    """A one-dimensional (or scalar) dataset of an HDF5 file, opened only while read."""

    path: Path
    dataset: str
    units: str
    size: int
    constant: bool

    def __len__(self) -> int:
        return self.size

    def read(self, start: int, stop: int) -> npt.NDArray[Any]:
        """Values of the events from `start` to before `stop`."""
        with opened(self.path) as file:
            if self.constant:
                return np.full(stop - start, file[self.dataset][()])
            return np.asarray(file[self.dataset][start:stop])


def columns_of(path: Path, group: h5py.Group) -> dict[str, Hdf5Column]:
    """Columns of numbers in a group: its datasets of one dimension or none."""
    members = {name: group.get(name) for name in group}
    return {name: _column(path, m) for name, m in members.items() if _is_column(m)}


def column_of(path: Path, name: str) -> Hdf5Column:
    """One column of an HDF5 file, by its path within the file.

    Raises
    ------
    CpunetError
        If there is no such file or column, with the columns beside it.
    """
    with opened(path) as file:
        found = file.get(name)
        if _is_column(found):
            return _column(path, found)
        parent = file.get(name.strip("/").rpartition("/")[0] or "/")
        known = list(columns_of(path, parent)) if isinstance(parent, h5py.Group) else list(file)
    raise CpunetError(f"{path}: no column {name}; there are {shortened(known)}")


def text_attribute(item: h5py.Group | h5py.Dataset, name: str) -> str:
    """An attribute of text, ``""`` if it is not there."""
    value = item.attrs.get(name, "")
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _is_column(item: object) -> bool:
    return isinstance(item, h5py.Dataset) and item.ndim <= 1 and item.dtype.kind in "iufb"


def _column(path: Path, dataset: h5py.Dataset) -> Hdf5Column:
    units = text_attribute(dataset, "units")
    return Hdf5Column(path, dataset.name, units, dataset.size, dataset.ndim == 0)


def _one_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
