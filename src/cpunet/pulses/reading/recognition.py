"""Recognise the format of a file by its first bytes, and check it against its suffix."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Literal

from cpunet.errors import CpunetError
from cpunet.regular_files import require_file

Format = Literal["hdf5", "fcio", "spe", "npz", "npy", "pickle", "text"]

_NAMES: dict[Format, str] = {
    "hdf5": "HDF5",
    "fcio": "FlashCam",
    "spe": "spectrum",
    "npz": "NumPy",
    "npy": "NumPy",
    "pickle": "pickle",
    "text": "text",
}
_SUFFIXES: dict[str, Format] = {
    ".lh5": "hdf5",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".hdf": "hdf5",
    ".fcio": "fcio",
    ".spe": "spe",
    ".npz": "npz",
    ".npy": "npy",
    ".pickle": "pickle",
    ".pkl": "pickle",
}
_HEAD_BYTES = 520
_HDF5 = b"\x89HDF\r\n\x1a\n"
_PICKLE, _PICKLE_PROTOCOLS = 0x80, range(2, 6)
_TEXT_BYTES = set(range(0x20, 0x7F)) | set(b"\t\r\n\f")
# signs of any encoding, but no control characters
_COMMENT = re.compile(rb"#[^\x00-\x1f\x7f]*")


def recognise(path: Path) -> Format:
    """Return the format of a file, from its content.

    Raises
    ------
    CpunetError
        If there is no such file, or it is a folder, empty, of an unknown format, or of another
        format than its suffix says.
    """
    head = _head(path)
    found = _by_content(head, path)
    claimed = _SUFFIXES.get(path.suffix.lower())
    # any text is accepted, unless its suffix is that of another format; pickles of protocol 0
    # are text
    if found == "text" and claimed is not None:
        found = "pickle" if claimed == "pickle" else None
    if found is not None:
        return found
    if claimed is not None:
        raise CpunetError(
            f"{path}: not a {_NAMES[claimed]} file, despite its name; "
            "give a file of pulses or correct its suffix"
        )
    raise CpunetError(
        f"{path}: of no known format; give LH5, HDF5, FlashCam .fcio, NumPy .npz or .npy, "
        "pickled pulses, or siggen's .spe or text"
    )


def _head(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise CpunetError(f"{path}: is a folder; give a file of pulses")
        with require_file(path).open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise CpunetError(f"{path}: no such file; check the name") from None
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror}); check it") from error
    if not head:
        raise CpunetError(f"{path}: is empty; copy or write it again")
    return head


def _by_content(head: bytes, path: Path) -> Format | None:
    # MATLAB writes 512 bytes of its own before the HDF5 part
    if _HDF5 in (head[:8], head[512:520]):
        return "hdf5"
    if head.startswith(b"\x93NUMPY"):
        return "npy"
    if head.startswith(b"PK\x03\x04"):
        return "npz"
    # the FCIO library unpacks these two itself, by their suffix
    if head[4:12] == b"FlashCam" or path.name.endswith((".fcio.gz", ".fcio.zst")):
        return "fcio"
    # Fortran record marks around the 24 bytes of a Radware header
    if len(head) >= 36 and struct.unpack_from("<i24xi", head) == (24, 24):
        return "spe"
    if head[0] == _PICKLE and len(head) > 1 and head[1] in _PICKLE_PROTOCOLS:
        return "pickle"
    if set(_COMMENT.sub(b"", head)) <= _TEXT_BYTES:
        return "text"
    return None
