"""Rows of LH5 objects, read only once their structure has been checked.

The LH5 library decodes waveforms with compiled loops that trust their input: a length with
one wrong bit would make them write beyond their arrays.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import lh5
import numpy as np
import numpy.typing as npt
from lgdo import ArrayOfEncodedEqualSizedArrays, VectorOfEncodedVectors
from lh5.compression import decode

from cpunet.errors import CpunetError
from cpunet.hdf5_files import text_attribute
from cpunet.kernels import kernel
from cpunet.pulses.reading.source import MAX_SAMPLES

_RADWARE, _VARLEN = "radware_sigcompress", "uleb128_zigzag_diff"


def read_rows(item: h5py.Group | h5py.Dataset, start: int, n: int) -> Any:
    """Rows of an LH5 object, read with the LH5 library, with decoded waveforms.

    Raises
    ------
    CpunetError
        If lengths of vectors or encoded waveforms contradict each other.
    """
    if "encoded" not in text_attribute(item, "datatype"):
        _check_vectors(item, start, n)
        return lh5.read(item.name, item.file, start_row=start, n_rows=n)
    _check_lengths(item["encoded_data"], start, n)
    raw = lh5.read(item.name, item.file, start_row=start, n_rows=n, decompress=False)
    _check_encoded(Path(item.file.filename), item.name, start, raw)
    return decode(raw)


def _check_vectors(item: h5py.Group | h5py.Dataset, start: int, n: int) -> None:
    """Check all vectors within an object, and all encoded waveforms."""
    if not isinstance(item, h5py.Group):
        return
    if "encoded" in text_attribute(item, "datatype"):
        read_rows(item, start, n)
    elif "cumulative_length" in item:
        _check_lengths(item, start, n)
    else:
        for name in item:
            inner = item.get(name)
            if isinstance(inner, h5py.Group):
                _check_vectors(inner, start, n)


def _check_lengths(vectors: h5py.Group, start: int, n: int) -> None:
    """Check that the cumulative lengths of some rows increase within the stored values."""
    path, ends = Path(vectors.file.filename), vectors.get("cumulative_length")
    flat = vectors.get("flattened_data")
    while isinstance(flat, h5py.Group):  # vectors of vectors
        flat = flat.get("cumulative_length")
    known = isinstance(ends, h5py.Dataset) and isinstance(flat, h5py.Dataset)
    if not known or ends.ndim != 1 or ends.dtype.kind not in "iu" or flat.ndim < 1:
        raise CpunetError(f"{path}: {vectors.name} holds no vectors; write the file again")
    there = ends[max(start - 1, 0) : start + n]
    if there.dtype.kind == "u" and there.size and int(there.max()) > np.iinfo(np.int64).max:
        last = -1
    else:
        steps = np.diff(there.astype(np.int64), prepend=0 if start == 0 else there[:1])
        last = -1 if (steps < 0).any() else int(there[-1]) if there.size else 0
    if not 0 <= last <= flat.shape[0]:
        raise CpunetError(
            f"{path}: event {start}: the lengths of {vectors.name} contradict its values; "
            "copy or write the file again"
        )


def _check_encoded(path: Path, name: str, start: int, raw: Any) -> None:
    if not isinstance(raw, ArrayOfEncodedEqualSizedArrays | VectorOfEncodedVectors):
        raise CpunetError(f"{path}: {name} holds no encoded waveforms; write the file again")
    ends = np.asarray(raw.encoded_data.cumulative_length.nda, np.int64)
    data = np.asarray(raw.encoded_data.flattened_data.nda)
    size = raw.decoded_size
    lengths = np.asarray(getattr(size, "nda", getattr(size, "value", None)))
    if lengths.dtype.kind not in "iu" or data.dtype.itemsize != 1:
        raise CpunetError(f"{path}: {name} holds no encoded waveforms; write the file again")
    lengths = np.broadcast_to(lengths, ends.shape).astype(np.int64)
    codec = str(raw.attrs.get("codec", ""))
    if codec not in (_RADWARE, _VARLEN):
        raise CpunetError(f"{path}: {name} has an unknown encoding {codec!r}; decode it")
    bad = (lengths < 1) | (lengths > MAX_SAMPLES)
    if bad.any():
        row = int(bad.argmax())
    else:
        check = first_bad_radware if codec == _RADWARE else first_bad_varlen
        row = check(data.view(np.uint8), ends, lengths)
    if row >= 0:
        raise CpunetError(
            f"{path}: event {start + row}: its encoded waveform is damaged; copy the file again"
        )


@kernel
def first_bad_varlen(
    data: npt.NDArray[np.uint8], ends: npt.NDArray[np.int64], lengths: npt.NDArray[np.int64]
) -> int:
    """First row that does not contain its number of variable-length integers; -1 if none.

    Parameters
    ----------
    data
        Bytes of all rows.
    ends
        End of each row in `data`.
    lengths
        Number of samples of each row.
    """
    first = 0
    for row in range(len(ends)):
        found, run = 0, 0
        for at in range(first, ends[row]):
            run += 1
            if data[at] & 0x80 == 0:
                found += 1
                run = 0
            elif run > 5:  # more bits than an integer has
                return row
        if found != lengths[row] or run != 0:
            return row
        first = ends[row]
    return -1


@kernel
def first_bad_radware(
    data: npt.NDArray[np.uint8], ends: npt.NDArray[np.int64], lengths: npt.NDArray[np.int64]
) -> int:
    """First row whose sections, in words of two bytes, do not match its length; -1 if none.

    A section consists of its number of samples, the bits per sample (plus 32 if these are
    differences), one or two initial values, and the packed bits.  For the arguments see
    `first_bad_varlen`.
    """
    first = 0
    for row in range(len(ends)):
        n_words = (ends[row] - first) // 2
        if n_words < 1 or 256 * data[first] + data[first + 1] != lengths[row]:
            return row
        done, word = 0, 1
        while word < n_words and done < lengths[row]:
            if word + 2 > n_words:
                return row
            at = first + 2 * word
            n = 256 * np.int64(data[at]) + data[at + 1]
            bits = 256 * np.int64(data[at + 2]) + data[at + 3]
            head, coded = 3, n
            if bits >= 32:
                head, coded, bits = 4, n - 1, bits - 32
            if n < 1 or bits > 16:
                return row
            word += head + (coded * bits + 15) // 16
            done += n
        if done < lengths[row] or word > n_words:
            return row
        first = ends[row]
    return -1
