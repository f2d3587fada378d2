"""Read NumPy files safely: the header of an array is checked before its values are read.

A header cannot be trusted: its shape can exceed the memory, its file can be truncated, and a
few kilobytes of an archive can unpack to gigabytes.
"""

from __future__ import annotations

import lzma
import math
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from cpunet.machine_memory import require_memory

# Exceptions of NumPy and zipfile on damaged files: headers are parsed as Python source, and
# archives can declare any encryption or compression.
DAMAGED = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    IndexError,
    TypeError,
    OverflowError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
    RecursionError,
    SyntaxError,
    TokenError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)
# Largest possible compression ratio, the limit of deflate.
_MAX_SHRINKAGE = 1100
MAX_BYTES = 1 << 31  # of an array that is read at once


@dataclass(frozen=True)
class Header:
    """Header of an array."""

    shape: tuple[int, ...]
    by_columns: bool
    dtype: np.dtype[Any]

    @property
    def n_bytes(self) -> int:
        """Size of all values in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def keys(path: Path) -> list[str]:
    """Names of the arrays of an archive; ``[""]`` for a file with one array."""
    prefix = np.lib.format.MAGIC_PREFIX
    with path.open("rb") as file:
        # the values of an array can look like the end of an archive
        if file.read(len(prefix)) == prefix or not zipfile.is_zipfile(path):
            return [""]
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    return [name.removesuffix(".npy") for name in names if name.endswith(".npy")]


@contextmanager
def member(path: Path, key: str) -> Iterator[IO[bytes]]:
    """Open the ``.npy`` member of that name, or the file itself for ``""``."""
    if not key:
        with path.open("rb") as file:
            yield file
    else:
        with zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as part:
            yield part


def read_header(file: IO[bytes]) -> Header:
    """Read the header of an array; its values come next in the file.

    Raises
    ------
    ValueError
        If the header is invalid.
    """
    read = (
        np.lib.format.read_array_header_1_0
        if np.lib.format.read_magic(file) == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, by_columns, dtype = read(file)
    if any(extent < 0 for extent in shape):
        raise ValueError(f"an array of shape {shape}")
    return Header(shape, by_columns, dtype)


def headers(path: Path) -> dict[str, Header]:
    """Headers of all arrays of a file, after a check that their values exist.

    Raises
    ------
    ValueError
        If an array has fewer values than its header says, or an archive declares an
        impossible size.
    """
    found: dict[str, Header] = {}
    for key in keys(path):
        with member(path, key) as file:
            header = read_header(file)
            there = _size(path, key) - file.tell()
        if header.n_bytes > there and not header.dtype.hasobject:
            name = f"array {key}" if key else "the array"
            raise ValueError(f"{name} is cut off: {there} of {header.n_bytes} bytes")
        found[key] = header
    return found


def read_array(path: Path, key: str, header: Header) -> npt.NDArray[Any]:
    """Read all values of an array.

    Raises
    ------
    ValueError
        If the array contains objects, is larger than `MAX_BYTES`, or does not match its
        header.
    CpunetError
        If there is not enough memory.
    """
    if header.dtype.hasobject:
        raise ValueError("objects instead of numbers")
    if header.n_bytes > MAX_BYTES:
        raise ValueError(f"an array of {header.n_bytes / 1e9:.0f} GB")
    require_memory(header.n_bytes, f"{path}: '{key}'", "give a smaller file")
    with member(path, key) as file:
        values: npt.NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return values


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, npt.NDArray[Any]]:
    """Read all values of some arrays of an archive; missing arrays are left out.

    Raises
    ------
    DAMAGED
        If the file cannot be read.
    """
    found = headers(path)
    return {name: read_array(path, name, found[name]) for name in names if name in found}


def said(error: BaseException) -> str:
    """Message of one of `DAMAGED` as one short line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else f"{text[:160]}…"


def _size(path: Path, key: str) -> int:
    """Unpacked size of a member in bytes, according to its archive."""
    total = path.stat().st_size
    if not key:
        return total
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(f"{key}.npy")
    if info.compress_size > total or info.file_size > _MAX_SHRINKAGE * info.compress_size + 512:
        raise ValueError(f"array {key} claims {info.file_size} bytes in a file of {total}")
    return info.file_size
