"""Compiled loops: their code is stored, and compiled again when a module of loops changes.

numba itself looks only at the file of a function, and so uses old code of functions that it
calls in other files.  Therefore code is stored in a folder named by a digest of all modules
with loops and of all that they import: in ``NUMBA_CACHE_DIR``, else in the cache of the user.
If neither can be written to, each process compiles anew.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import os
import re
import shutil
import sys
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, overload

import numba
import platformdirs
import threadpoolctl
from numba.core import config

from cpunet.errors import CpunetError

Loop = TypeVar("Loop", bound=Callable[..., Any])

_MAX_FOLDERS = 8  # one for each state of the sources, some 5 MB


@overload
def kernel(function: Loop) -> Loop: ...


@overload
def kernel(**options: Any) -> Callable[[Loop], Loop]: ...


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a loop with numba's ``njit``, releasing the GIL, and cache its code."""
    if function is None:
        return functools.partial(kernel, **options)
    if options.get("fastmath"):
        # The compiler chooses the order of sums.  A caller would use the loop's own code where
        # it was compiled, and a copy compiled with the caller where it was loaded from the
        # cache; their last bits differ.  Inlined into the caller there is only one version.
        options.setdefault("forceinline", True)
    folder, before = code_folder(), config.CACHE_DIR
    config.CACHE_DIR = str(folder)
    try:
        compiled = numba.njit(nogil=True, cache=folder is not None, **options)(function)
    finally:
        config.CACHE_DIR = before
    if folder is not None:
        # numba numbers files from 1: of two processes that compile a loop for different types
        # at once, one would load the other's code
        stored = compiled._cache._cache_file  # noqa: SLF001  numba has no public way
        stored._data_name_pattern = f"{function.__name__}-{uuid.uuid4().hex}.{{number:d}}.nbc"  # noqa: SLF001
    if not options.get("parallel"):
        return compiled

    @functools.wraps(function)
    def in_own_threads(*given: Any) -> Any:
        if start_threads() != os.getpid():  # a forked process has no threads but this
            raise CpunetError(
                "loops of several threads do not work in a forked process; begin processes "
                'with multiprocessing.get_context("spawn")'
            )
        return compiled(*given)

    return in_own_threads


def _after_fork() -> None:
    if "torch" in sys.modules:  # which would wait for threads that its parent had
        sys.modules["torch"].set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


@functools.cache
def start_threads() -> int:
    """Start numba's threads, and return the process that they are in.

    OpenMP, which torch uses as well, keeps its number of threads.

    numba starts them with the first parallel loop and then sets OpenMP's number for the whole
    process.  From then on torch would use another number of threads than it was set to, and the
    last bits of a network's output depend on that number.
    """
    with suppress(ImportError):  # another threading layer
        importlib.import_module("numba.np.ufunc.omppool")  # loads OpenMP: it has a number now
    with threadpoolctl.ThreadpoolController().select(user_api="openmp").limit(limits=None):
        try:
            numba.get_num_threads()
        except ValueError:  # NUMBA_THREADING_LAYER asks for one that is not installed
            config.THREADING_LAYER = "default"
            numba.get_num_threads()
    asked = os.environ.get("OMP_NUM_THREADS", "")  # which numba does not look at
    if asked.isdecimal() and int(asked) and "NUMBA_NUM_THREADS" not in os.environ:
        numba.set_num_threads(min(int(asked), config.NUMBA_NUM_THREADS))
    return os.getpid()


def use_threads(count: int) -> None:
    """Set the number of threads of this process, for torch as well if that is imported."""
    os.environ["OMP_NUM_THREADS"] = str(count)  # which torch reads when it is imported later
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)
    start_threads()
    numba.set_num_threads(min(count, config.NUMBA_NUM_THREADS))


@functools.cache
def code_folder() -> Path | None:
    """Folder of the code of these sources; of earlier ones the last few remain.

    Its name is a digest of all modules with loops and of those that they import.
    """
    home, texts, used = Path(__file__).parent, dict[str, str](), set[str]()
    for file in home.rglob("*.py"):
        parts = (home.name, *file.relative_to(home).with_suffix("").parts)
        texts[".".join(parts).removesuffix(".__init__")] = file.read_text(encoding="utf-8")
    ahead = [name for name, text in texts.items() if f"{__name__} import" in text]
    while ahead:
        used.add(name := ahead.pop())
        imported = re.findall(r"^from ([\w.]+) import", texts[name], re.MULTILINE)
        ahead += [other for other in imported if other in texts.keys() - used]
    digest = hashlib.sha256("\0".join(texts[name] for name in sorted(used)).encode())
    base = Path(config.CACHE_DIR or platformdirs.user_cache_path("cpunet") / "loops")
    folder = base / f"cpunet-{digest.hexdigest()[:16]}"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        return None
    with suppress(OSError):  # another process removes them as well
        folders = sorted(base.glob("cpunet-*"), key=lambda place: place.stat().st_mtime)
        for old in folders[:-_MAX_FOLDERS]:
            shutil.rmtree(old)
    return folder
