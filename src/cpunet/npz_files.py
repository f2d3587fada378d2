"""NumPy files read with care: what an array says of itself is checked before it is read.

A header is a claim: its shape may ask for more memory than there is, its file may be cut off,
and a few kilobytes of an archive may unpack to gigabytes.
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

# What NumPy and zipfile raise on damaged files: headers are parsed as Python source, and
# archives may claim any encryption or compression.
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
# No archive of pulses or hits shrinks its arrays by more: the limit of deflate itself.
_MOST_SHRINKAGE = 1100
MOST_BYTES = 1 << 31  # of an array that is read whole


@dataclass(frozen=True)
class Header:
    """What an array says of itself."""

    shape: tuple[int, ...]
    by_columns: bool
    dtype: np.dtype[Any]

    @property
    def n_bytes(self) -> int:
        """Bytes of all its values."""
        return math.prod(self.shape) * self.dtype.itemsize


def keys(path: Path) -> list[str]:
    """Names of the arrays of an archive; ``[""]`` for a file of one array."""
    if not zipfile.is_zipfile(path):
        return [""]
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    return [name.removesuffix(".npy") for name in names if name.endswith(".npy")]


@contextmanager
def member(path: Path, key: str) -> Iterator[IO[bytes]]:
    """The ``.npy`` part of that name, or (``""``) the file itself."""
    if not key:
        with path.open("rb") as file:
            yield file
    else:
        with zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as part:
            yield part


def read_header(file: IO[bytes]) -> Header:
    """The header of an array, whose values come next.

    Raises
    ------
    ValueError
        If it makes no sense.
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
    """The headers of all arrays of a file, whose values are known to be there.

    Raises
    ------
    ValueError
        If there are fewer values than an array says, or an archive unpacks to more than it can.
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
    """Read the values of an array whole.

    Raises
    ------
    ValueError
        If it holds objects, is larger than `MOST_BYTES`, or is not there as it was said.
    """
    if header.dtype.hasobject:
        raise ValueError("objects instead of numbers")
    if header.n_bytes > MOST_BYTES:
        raise ValueError(f"an array of {header.n_bytes / 1e9:.0f} GB")
    with member(path, key) as file:
        values: npt.NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return values


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, npt.NDArray[Any]]:
    """Read arrays of an archive whole; those that it lacks are left out.

    Raises
    ------
    DAMAGED
        If the file cannot be read.
    """
    found = headers(path)
    return {name: read_array(path, name, found[name]) for name in names if name in found}


def said(error: BaseException) -> str:
    """What one of `DAMAGED` says, in one line that is not too long."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else f"{text[:160]}…"


def _size(path: Path, key: str) -> int:
    """Bytes of a part once unpacked, as far as its archive can be believed."""
    total = path.stat().st_size
    if not key:
        return total
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(f"{key}.npy")
    if (
        info.compress_size > total
        or info.file_size > _MOST_SHRINKAGE * info.compress_size + 512
    ):
        raise ValueError(f"array {key} claims {info.file_size} bytes in a file of {total}")
    return info.file_size
