"""Datasets of a translated pulse-shape library, filled row by row in r."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.hdf5_files import text_attribute
from cpunet.legend.templates import AFTER_NS, BEFORE_NS, aligned_currents
from cpunet.pulses.container import FloatArray
from cpunet.pulses.reading.energies import TIME_UNITS


@dataclass(frozen=True)
class Arrays:
    """Datasets for templates and, for currents, for the times of their maxima."""

    waveforms: h5py.Dataset
    times: h5py.Dataset | None = None

    def put(self, rows: slice, charge: FloatArray, dt_ns: float) -> None:
        """Write translated templates, shape (grid points, samples), of rows of r."""
        values = charge
        if self.times is not None:
            values, times_ns = aligned_currents(charge, dt_ns)
            self.times[rows] = times_ns.reshape(-1, self.times.shape[1])
        self.waveforms[rows] = values.reshape(-1, *self.waveforms.shape[1:])


def put_column(group: h5py.Group, name: str, values: npt.ArrayLike, units: str) -> None:
    """Store a number or an array with LH5 attributes."""
    group[name] = values
    dimensions = group[name].ndim
    kind = f"array<{dimensions}>{{real}}" if dimensions else "real"
    group[name].attrs.update({"datatype": kind, "units": units})


def charge_arrays(given: h5py.Dataset, made: h5py.Group, angle: str) -> Arrays:
    """Create a dataset of the same type, shape, chunks, filters and attributes."""
    plain = given.id
    name = f"waveform_{angle}".encode()
    new = h5py.h5d.create(
        made.id, name, plain.get_type(), plain.get_space(), plain.get_create_plist()
    )
    waveforms = h5py.Dataset(new)
    waveforms.attrs.update(given.attrs)
    return Arrays(waveforms)


def current_arrays(given: h5py.Dataset, made: h5py.Group, angle: str, dt_ns: float) -> Arrays:
    """Create datasets for currents and for the times of their maxima in ns.

    Currents of templates of whole numbers are float32, since in 1/ns they are below 1.
    """
    samples = round(BEFORE_NS / dt_ns) + round(AFTER_NS / dt_ns)
    n_r, n_z, _ = given.shape
    options: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    waveforms = made.create_dataset(
        f"waveform_{angle}",
        (n_r, n_z, samples),
        given.dtype if given.dtype.kind == "f" else np.float32,
        chunks=(1, n_z, samples),
        **options,
    )
    waveforms.attrs.update({**given.attrs, "units": "1/ns"})
    times = made.create_dataset(f"drift_time_{angle}", (n_r, n_z), np.float64)
    times.attrs.update({"datatype": "array<2>{real}", "units": "ns"})
    return Arrays(waveforms, times)


def add_t0(dt: h5py.Dataset, made: h5py.Group, dt_ns: float, before_ns: float) -> None:
    """Add ``t0``, `before_ns` before time 0, in the units of ``dt``."""
    units = text_attribute(dt, "units")
    t0 = -round(before_ns / dt_ns) * dt_ns / TIME_UNITS[units]
    put_column(made, "t0", t0, units)
