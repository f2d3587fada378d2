"""On-disk cache of compiled loops, invalidated only when code that they use changes.

numba's own cache checks only the file of a function, so the function keeps old code of
functions that it calls in other files.  Moreover, if two processes compile at once, as the
first jobs after an installation do, one can load the other's code.  Neither happens here: the
second process waits for the code of the first.

numba chooses the folder: beside the package, or ``NUMBA_CACHE_DIR``.  A folder to which others
can write is never used, since it would let them execute any code; then the user's own cache
is used.  Damaged files are compiled again.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import pickle
import re
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar, overload

import numba
import platformdirs
import threadpoolctl
from numba.core import config
from numba.core.caching import FunctionCache, IndexDataCacheFile

from cpunet.errors import CpunetError
from cpunet.file_locks import lock
from cpunet.trusted_folders import trusted

Loop = TypeVar("Loop", bound=Callable[..., Any])

# Maximum wait for code that another process compiles, in case that process hangs.
MAX_WAIT_S = 60.0
_DIGEST_BYTES = hashlib.sha256().digest_size
_IMPORT = re.compile(r"^(?:from ([\w.]+) )?import (\([^)]*|.*)", re.MULTILINE)


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
    compiled = numba.njit(nogil=True, **options)(function)
    cache = _Cache(function, parallel=bool(options.get("parallel")))
    compiled._cache = cache  # noqa: SLF001  numba has no public way
    return compiled


@functools.cache
def start_threads() -> None:
    """Start numba's threads; OpenMP, which torch uses as well, keeps its number of threads.

    numba starts them with the first parallel loop and then sets OpenMP's number for the whole
    process.  From then on torch would use another number of threads than it was told, and the
    last bits of a network's output depend on that number.
    """
    with suppress(ImportError):  # another threading layer
        importlib.import_module("numba.np.ufunc.omppool")  # loads OpenMP: it has a number now
    with threadpoolctl.ThreadpoolController().select(user_api="openmp").limit(limits=None):
        numba.get_num_threads()


def use_threads(count: int) -> None:
    """Set the number of threads of torch, and let parallel loops use no more than these."""
    import torch  # seconds, which compiled loops alone do not need

    torch.set_num_threads(count)
    start_threads()
    numba.set_num_threads(min(count, config.NUMBA_NUM_THREADS))


@contextmanager
def at_most_threads(count: int) -> Iterator[None]:
    """Let parallel loops that this thread calls use at most `count` threads."""
    start_threads()
    before = numba.get_num_threads()
    numba.set_num_threads(min(before, count))
    try:
        yield
    finally:
        numba.set_num_threads(before)


@functools.cache
def sources(module: str) -> frozenset[Path]:
    """Files of a module and of all modules of its package that it imports at the top."""
    package = module.partition(".")[0]
    seen, ahead = {module}, [module]
    found = set()
    while ahead:
        file = Path(str(sys.modules[ahead.pop()].__file__))
        found.add(file)
        names = set[str]()
        for origin, items in _IMPORT.findall(file.read_text(encoding="utf-8")):
            words = re.findall(r"[\w.]+", items)
            names |= {origin, *words, *(f"{origin}.{word}" for word in words)}
        ours = [n for n in names - seen if n.partition(".")[0] == package and n in sys.modules]
        seen.update(ours)
        ahead += ours
    return frozenset(found)


@functools.cache
def digest(module: str) -> str:
    """Digest of the sources of a module, independent of their location."""
    contents = sorted(file.read_bytes() for file in sources(module))
    return hashlib.sha256(b"\0".join(contents)).hexdigest()


def code_folder(chosen: Path) -> Path | None:
    """The cache folder: the chosen one, or a replacement if that is not trusted.

    Returns
    -------
    Path or None
        None if no folder is writable by the user alone.
    """
    if trusted(chosen):
        return chosen
    own = platformdirs.user_cache_path("cpunet") / "kernels" / chosen.resolve().name
    own = own.with_name(
        f"{own.name}-{hashlib.sha256(bytes(chosen.resolve())).hexdigest()[:16]}"
    )
    try:
        own.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    return own if trusted(own) else None


class KernelFiles(IndexDataCacheFile):  # type: ignore[misc]
    """Files of one function: an index, and one file of code per signature.

    Code is preceded by a digest.  Damaged code and damaged indices are ignored.
    """

    def _load_index(self) -> dict[Any, str]:
        try:
            found = super()._load_index()
        except Exception:  # unpickling damaged bytes can raise anything
            return {}
        return found if isinstance(found, dict) else {}

    def _load_data(self, name: str) -> Any:
        content = (Path(self._cache_path) / name).read_bytes()
        known, code = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        if hashlib.sha256(code).digest() != known:
            raise OSError("damaged")  # numba treats it as missing
        return pickle.loads(code)

    def _save_data(self, name: str, data: Any) -> None:
        code = self._dump(data)
        with self._open_for_write(self._data_path(name)) as stream:
            stream.write(hashlib.sha256(code).digest() + code)

    def save(self, key: Any, data: Any) -> None:
        """Cache code; another process may do so at the same time.

        If that fails, as on a full disk, the code is compiled again next time.
        """
        with suppress(OSError):
            self._keep(key, data)

    def _keep(self, key: Any, data: Any) -> None:
        # numba numbers files from 1, so two processes would give different code the same name
        name = self._data_name_pattern.format(number=uuid.uuid4().int)
        self._save_data(name, data)  # first, so that files in the index exist
        kept = self._load_index() | {key: name}
        self._save_index(kept)
        # code of older sources, and files that another process has removed from the index
        pattern = self._data_name_pattern.format(number=0).replace(".0.", ".*.")
        for file in Path(self._cache_path).glob(pattern):
            if file.name not in kept.values():
                with suppress(OSError):
                    file.unlink()  # a process that looks for it compiles again


class _Cache(FunctionCache):  # type: ignore[misc]
    """numba's cache of one function, valid as long as its sources are unchanged."""

    _cache_path: str

    def __init__(self, function: Callable[..., Any], *, parallel: bool) -> None:
        super().__init__(function)
        self._parallel = parallel
        self._claim: IO[str] | None = None
        folder = code_folder(Path(self._cache_path))
        if folder is None:
            self.disable()
            return
        self._cache_path = str(folder)
        self._cache_file = KernelFiles(
            self._cache_path, self._impl.filename_base, digest(function.__module__)
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for a signature; None if this process must compile it.

        If another process is compiling the function, wait for its code.
        """
        if self._parallel:
            start_threads()  # before numba does so itself when it loads or compiles the loop
        found = super().load_overload(sig, target_context)
        if found is None and self._enabled:
            self._claim = _claimed(Path(self._cache_path) / f"{self._impl.filename_base}.lock")
            found = super().load_overload(sig, target_context)
            if found is not None:
                self._release()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Cache code, and let waiting processes load it."""
        try:
            super().save_overload(sig, data)
        finally:
            self._release()

    def _release(self) -> None:
        if self._claim is not None:
            with suppress(OSError):
                Path(self._claim.name).unlink()
            self._claim.close()
            self._claim = None


def _claimed(path: Path) -> IO[str] | None:
    """Open and lock a file, waiting up to `MAX_WAIT_S`; None if it cannot be opened."""
    try:
        stream = path.open("a")
    except OSError:
        return None
    end = time.monotonic() + MAX_WAIT_S
    while time.monotonic() < end:
        try:
            lock(stream.fileno(), "compiling")
        except CpunetError:
            time.sleep(0.02)
        else:
            break
    return stream
