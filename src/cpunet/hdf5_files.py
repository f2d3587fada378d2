"""Open HDF5 files for reading, and convert library errors on damaged files."""

from __future__ import annotations

import math
import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

# The package provides the compression filters of LEGEND's files.
from lh5.io.exceptions import LH5DecodeError

from cpunet.errors import CpunetError
from cpunet.file_probe import require_survivable
from cpunet.regular_files import require_file

_HERE = str(Path(__file__).parent)
MAX_CHUNK_BYTES = 1 << 30
_LIBRARIES = re.compile(r"(^|[/\\])(h5py|lh5|lgdo|awkward|numpy)[/\\]")


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; library errors inside become a `CpunetError`.

    File locking is off, since shared file systems of clusters often lack it.

    Raises
    ------
    CpunetError
        If the file is missing, damaged or not HDF5.
    """
    require_file(path)
    require_survivable(path)
    with reading(path), h5py.File(path, "r", locking=False) as file:
        yield file


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Context manager that converts library errors on a damaged file to a `CpunetError`."""
    try:
        yield
    except FileNotFoundError:
        raise CpunetError(f"{path}: no such file; check the name") from None
    except CpunetError:
        raise
    except (OSError, RuntimeError, ValueError, LH5DecodeError) as error:
        raise _damaged(path, error) from error
    except Exception as error:
        if not _from_a_library(error):
            raise
        raise _damaged(path, error) from error


def text_attribute(item: h5py.Group | h5py.Dataset, name: str) -> str:
    """A text attribute, ``""`` if it is missing."""
    value = item.attrs.get(name, "")
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def is_column(item: object) -> bool:
    """Whether an object of a file is a one-dimensional array of numbers, or one number."""
    if not isinstance(item, h5py.Dataset) or item.shape is None:  # a dataset without values
        return False
    return item.ndim <= 1 and item.dtype.kind in "iufb"


def require_all_stored(path: Path, item: h5py.Group | h5py.Dataset) -> None:
    """Like `require_stored`, for all datasets of a group."""
    ahead, seen = [item], set[tuple[int, int]]()
    while ahead:
        inner = ahead.pop()
        info = h5py.h5o.get_info(inner.id)
        if (info.fileno, info.addr) in seen:  # links can form circles
            continue
        seen.add((info.fileno, info.addr))
        if isinstance(inner, h5py.Dataset):
            require_stored(path, inner)
        elif isinstance(inner, h5py.Group):
            ahead += [found for name in inner if (found := inner.get(name)) is not None]


def require_stored(path: Path, dataset: h5py.Dataset) -> None:
    """Raise a `CpunetError` if the values of a dataset are not stored in the file.

    A file of a few bytes could otherwise be read as any number of zeros.
    """
    if dataset.shape is None:  # without values
        return
    n_bytes = math.prod(dataset.shape) * dataset.dtype.itemsize
    if math.prod(dataset.chunks or ()) * dataset.dtype.itemsize > MAX_CHUNK_BYTES:
        raise CpunetError(
            f"{path}: {dataset.name} is in chunks of {dataset.chunks}, too large to read; "
            "copy or write it again"
        )
    if n_bytes == 0 or dataset.is_virtual or dataset.external:
        return
    missing = dataset.id.get_storage_size() == 0
    if dataset.chunks is not None and not missing:
        extents = zip(dataset.shape, dataset.chunks, strict=True)
        expected = math.prod(-(-extent // chunk) for extent, chunk in extents)
        missing = dataset.id.get_num_chunks() < expected
    if missing:
        raise CpunetError(
            f"{path}: {dataset.name} says it has {dataset.size} values, but not all of them "
            "are in the file; copy or write it again"
        )


def _damaged(path: Path, error: Exception) -> CpunetError:
    text = str(error)
    if "truncated" in text:
        what = "is truncated"
    elif "file signature not found" in text:
        return CpunetError(f"{path}: not an HDF5 file; give an LH5 or HDF5 file")
    else:
        what = f"cannot be read ({_one_line(error)})"
    return CpunetError(f"{path}: {what}; copy or write it again")


def _from_a_library(error: Exception) -> bool:
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    ours = [i for i, file in enumerate(files) if file.startswith(_HERE)]
    beyond = files[ours[-1] + 1 :] if ours else files
    return any(map(_LIBRARIES.search, beyond))


def _one_line(error: Exception) -> str:
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    return text if len(text) <= 160 else f"{text[:160]}…"
