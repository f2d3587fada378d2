"""Read pickles of arrays and plain containers without executing anything.

A pickle is a program that can call any function by name.  Here the only permitted names are
those with which NumPy stores arrays and numbers.  They are mapped to objects of this module,
which check their arguments and build plain numeric arrays.  Any other name is refused, and
so are instructions that such arrays do not need.  The instructions are scanned first, so that
none of them can request more memory than the length of the file.
"""

from __future__ import annotations

import math
import os
import pickle
import pickletools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from cpunet.errors import CpunetError

KINDS = "biuf"  # booleans, integers, floats: no object references


# Instructions that name or build objects in other ways.
_FORBIDDEN = frozenset(
    {
        *("PERSID", "BINPERSID", "EXT1", "EXT2", "EXT4", "INST", "OBJ", "NEWOBJ"),
        *("NEWOBJ_EX", "NEXT_BUFFER", "READONLY_BUFFER"),
    }
)
_REMEMBER = frozenset(("PUT", "BINPUT", "LONG_BINPUT"))


class ForbiddenError(Exception):
    """The pickle contains something other than arrays, numbers and containers."""


class TruncatedError(Exception):
    """The pickle is truncated or damaged."""


class _Dtype:
    """Stand-in for a `numpy.dtype` of a pickle."""

    __slots__ = ("dtype",)

    def __init__(self, name: Any) -> None:
        if not isinstance(name, str) or np.dtype(name).kind not in KINDS:
            raise ForbiddenError(f"an array of {str(name)[:40]!r}")
        self.dtype = np.dtype(name)

    def __setstate__(self, state: Any) -> None:
        order = state[1]
        if order not in ("<", ">", "|", "=") or any(state[2:5]):
            raise ForbiddenError("an array of records")
        self.dtype = self.dtype.newbyteorder(order)


class _Array:
    """Stand-in for a `numpy.ndarray` of a pickle."""

    __slots__ = ("values",)

    def __init__(self) -> None:
        self.values: np.ndarray[Any, Any] = np.empty(0)

    def __setstate__(self, state: Any) -> None:
        _version, shape, dtype, fortran, raw = state
        self.values = _numbers(raw, dtype, shape, "F" if fortran else "C")


class _Name:
    """A permitted name of a pickle: it can be called and nothing else."""

    __slots__ = ("_name",)
    _name: str

    def __init__(self, name: str) -> None:
        object.__setattr__(self, "_name", name)

    def __setattr__(self, name: str, value: object) -> None:
        raise ForbiddenError("a change of a function")

    def __setstate__(self, state: Any) -> None:
        raise ForbiddenError("a change of a function")

    def __call__(self, *given: Any) -> Any:
        if self._name == "dtype":
            return _Dtype(given[0])
        if self._name == "_reconstruct":
            return _Array()
        if self._name == "scalar":
            return _numbers(given[1], given[0], (1,), "C").item()
        if self._name == "_frombuffer":
            array = _Array()
            array.values = _numbers(*given)
            return array
        if self._name == "encode":
            if given[1:] != ("latin1",) or not isinstance(given[0], str):
                raise ForbiddenError("an encoding other than latin1")
            return given[0].encode("latin1")
        raise ForbiddenError(f"a call of numpy.{self._name}")


_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")
_NUMERIC = ("numpy.core.numeric", "numpy._core.numeric")
_NAMES = frozenset(
    [("numpy", "dtype"), ("numpy", "ndarray"), ("_codecs", "encode")]
    + [(module, name) for module in _MODULES for name in ("_reconstruct", "scalar")]
    + [(module, "_frombuffer") for module in _NUMERIC]
)


def _numbers(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray[Any, Any]:
    """An array of the bytes, if their number matches the shape."""
    if not isinstance(dtype, _Dtype) or not isinstance(raw, (bytes, bytearray)):
        raise ForbiddenError("an array of objects")
    if order not in ("C", "F"):
        raise TruncatedError("an array without order")
    sizes = tuple(int(n) for n in (shape if isinstance(shape, tuple) else (shape,)))
    if any(n < 0 for n in sizes) or math.prod(sizes) * dtype.dtype.itemsize != len(raw):
        raise TruncatedError("an array of another size than its shape")
    return np.frombuffer(raw, dtype.dtype).reshape(sizes, order=order)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _NAMES:
            raise ForbiddenError(f"{module}.{name}"[:80])
        return _Name(name)


def load(stream: BinaryIO) -> Any:
    """Read the next object of a stream: arrays, numbers, strings and containers of them.

    Raises
    ------
    EOFError
        If the stream is at its end.
    ForbiddenError
        If the pickle names anything but NumPy's arrays and numbers; nothing was executed.
    TruncatedError
        If the pickle is truncated or damaged.
    """
    start = stream.tell()
    if not stream.read(1):
        raise EOFError
    stream.seek(start)
    try:
        _look_through(stream)
        stream.seek(start)
        return _plain(_Unpickler(stream).load())
    except (ForbiddenError, TruncatedError):
        raise
    except Exception as error:  # a damaged pickle can raise anything
        raise TruncatedError(str(error) or type(error).__name__) from error


def _look_through(stream: BinaryIO) -> None:
    """Refuse instructions that no array needs, up to the end of the next object."""
    start = stream.tell()
    size = stream.seek(0, os.SEEK_END)
    stream.seek(start)
    for count, (code, argument, _) in enumerate(pickletools.genops(stream)):
        if code.name in _FORBIDDEN:
            raise ForbiddenError(f"the instruction {code.name}")
        # memo entries are numbered consecutively
        if code.name in _REMEMBER and not 0 <= int(argument or 0) <= count:
            raise TruncatedError("memory out of turn")
        if code.name == "FRAME" and int(argument or 0) > size:
            raise TruncatedError("a frame longer than the file")


def load_all(path: Path) -> Iterator[Any]:
    """Yield the objects of a file of consecutive pickles, one at a time.

    Raises
    ------
    CpunetError
        If the file cannot be read or contains more than arrays and plain containers.
    TruncatedError
        If a pickle is truncated or damaged.
    """
    try:
        stream = path.open("rb")
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror})") from error
    with stream:
        while True:
            try:
                yield load(stream)
            except EOFError:
                return
            except ForbiddenError as error:
                raise CpunetError(
                    f"{path}: asks for {error}, which no list of pulses needs; refused, "
                    "nothing of it was executed"
                ) from error


def _plain(value: Any, done: dict[int, Any] | None = None) -> Any:
    """Replace stand-ins by arrays, also in nested lists, tuples and dictionaries.

    An object with many references is converted only once, so that a small file stays small.
    """
    done = {} if done is None else done
    if isinstance(value, _Array):
        return value.values
    if isinstance(value, (_Dtype, _Name)):
        raise ForbiddenError("a type instead of a value")
    if not isinstance(value, (dict, list, tuple)):
        return value
    if id(value) not in done:
        done[id(value)] = (
            {key: _plain(item, done) for key, item in value.items()}
            if isinstance(value, dict)
            else type(value)([_plain(item, done) for item in value])
        )
    return done[id(value)]
