"""Columns of HDF5 files: one value per event, read when they are needed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened, text_attribute
from cpunet.pulses.reading.energies import shortened


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


def columns_beside(path: Path, name: str) -> dict[str, Hdf5Column]:
    """Columns of the group in which a column of an HDF5 file stands."""
    with opened(path) as file:
        return columns_of(path, file[name].parent)


def column_of(path: Path, name: str) -> Hdf5Column:
    """Return a column of an HDF5 file by its path in the file.

    Raises
    ------
    CpunetError
        If there is no such file or column; the message lists the other columns of the group.
    """
    with opened(path) as file:
        found = file.get(name)
        if is_column(found):
            return _column(path, found)
        parent = file.get(name.strip("/").rpartition("/")[0] or "/")
        known = list(columns_of(path, parent)) if isinstance(parent, h5py.Group) else list(file)
    raise CpunetError(f"{path}: no column {name}; there are {shortened(known)}")


def _column(path: Path, dataset: h5py.Dataset) -> Hdf5Column:
    units = text_attribute(dataset, "units")
    return Hdf5Column(path, dataset.name, units, dataset.size, dataset.ndim == 0)
