"""Waveform tables of LH5 files, and error messages of failed writes."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

import h5py
import lh5
import numpy as np
import numpy.typing as npt
from lgdo import LGDO, ArrayOfEqualSizedArrays, WaveformTable

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

# Chunks of whole traces: a block of events is read without decompressing others.
_CHUNK_BYTES = 1 << 18
# Lowest gzip level: noise hardly compresses further, and it takes half the time.
_GZIP_LEVEL = 1


@contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Convert errors of the HDF5 library, such as a full disk, into a `CpunetError`."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise CpunetError(
            f"{path}: cannot be written ({os_reason(error)}); nothing was left"
        ) from error


class HeldFile(io.FileIO):
    """A file that stores its first failed write and hides it from the HDF5 library.

    After a failed write the library can neither continue nor close its file: it floods the
    screen with messages and can crash at exit.
    """

    failure: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """Write everything, unless this or an earlier write fails."""
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while len(left) and self.failure is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.failure = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Change the size, unless this or an earlier call fails."""
        try:
            if self.failure is None:
                return super().truncate(size)
        except OSError as error:
            self.failure = error
        return 0 if size is None else size


class FileInTheMaking:
    """An HDF5 file being written, whose errors are raised as `CpunetError`.

    Parameters
    ----------
    aside
        Temporary path that is written.
    target
        Final path, for error messages.
    mode
        ``"w"`` for a new file, ``"r+"`` to modify an existing one.
    """

    def __init__(self, aside: Path, target: Path, mode: Literal["w", "r+"] = "w") -> None:
        self._target = target
        with write_errors(target):
            self._held = HeldFile(aside, "w+" if mode == "w" else "r+")
            self.h5 = h5py.File(self._held, mode)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with write_errors(self._target):
            try:
                self.h5.close()
            finally:
                self._held.close()
            self._raise_failure()

    def write(self, item: LGDO, name: str, group: str) -> None:
        """Append rows to the object `name` in `group`."""
        with write_errors(self._target):
            lh5.write(item, name, self.h5, group=group, wo_mode="append")
            self._raise_failure()

    def _raise_failure(self) -> None:
        if self._held.failure is not None:
            raise self._held.failure


def os_reason(error: Exception) -> str:
    """The operating system's reason, which HDF5 hides in a message of many lines."""
    number = error.errno if isinstance(error, OSError) else None
    hidden = re.search(r"errno = (\d+)", str(error))
    if number is None and hidden is not None:
        number = int(hidden.group(1))
    return os.strerror(number) if number else " ".join(str(error).split())


def waveform_table(
    pulses: Pulses, *, t0_ns: float, units: str, samples: npt.DTypeLike = np.float32
) -> WaveformTable:
    """LH5 waveform table with the given sample type, in chunks of whole traces."""
    n_rows = max(1, _CHUNK_BYTES // (4 * max(1, pulses.length)))
    # not called "units": dspeed copies that attribute to its table buffer, which the LH5
    # library then refuses to fill a second time
    values = ArrayOfEqualSizedArrays(
        nda=pulses.waveforms.astype(samples, copy=False),
        attrs={
            "sample_units": units,
            "hdf5_settings": {
                "chunks": (n_rows, pulses.length),
                "compression": "gzip",
                "compression_opts": _GZIP_LEVEL,
                "shuffle": True,
            },
        },
    )
    return WaveformTable(
        t0=np.full(len(pulses), t0_ns),
        t0_units="ns",
        dt=np.full(len(pulses), pulses.dt_ns),
        dt_units="ns",
        values=values,
    )
