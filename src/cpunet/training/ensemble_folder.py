"""A folder of trainings that differ in their seed alone.

``ensemble.json``
    What all were trained with, and what became of each seed; rewritten after each.
``seed_000``, ``seed_001``, …
    Run folders; with ``metrics.json`` if they were scored.
``seed_002.unfinished``
    A training to go on with, see `cpunet.training.unfinished`.
"""

from __future__ import annotations

import fcntl
import json
import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.files import require_replaceable, written_aside
from cpunet.training.run_folder import INFO

ENSEMBLE = "ensemble.json"
_LOCK = ".lock"


def member_folder(ensemble: Path, seed: int) -> Path:
    """The run folder of a seed."""
    return Path(ensemble) / f"seed_{seed:03d}"


def finished_members(ensemble: Path) -> list[Path]:
    """Run folders of the seeds whose training is done, by seed.

    Raises
    ------
    CpunetError
        If there is none.
    """
    runs = [path.parent for path in Path(ensemble).glob(f"seed_*/{INFO}")]
    if not runs:
        raise CpunetError(
            f"{ensemble}: no folder of an ensemble with a finished seed; make one with "
            "`cpunet ensemble`"
        )
    return sorted(runs, key=lambda run: (len(run.name), run.name))


def require_usable(out: Path, marker: str, *, resume: bool, force: bool) -> None:
    """Raise a `CpunetError` if `out` is there and may be neither gone on with nor replaced."""
    out = Path(out)
    if out.exists() and not (resume or force):
        raise CpunetError(
            f"{out}: exists already; go on with --resume, or choose another name or --force"
        )
    left = [path.name for path in out.iterdir()] if out.is_dir() else []
    if left != [_LOCK]:  # of a process that was stopped before it had begun
        require_replaceable(out, marker=marker)


@contextmanager
def working_folder(
    out: Path, marker: str, *, resume: bool = False, force: bool = False, alone: bool = True
) -> Iterator[Path]:
    """Give a folder to work in that stays, whatever happens.

    Parameters
    ----------
    out
        The folder.
    marker
        A file that all folders of this kind hold; others are never replaced.
    resume
        Go on in an existing folder.
    force
        Without `resume`, empty an existing folder.
    alone
        Keep other processes out.

    Raises
    ------
    CpunetError
        As by `require_usable`; if it cannot be written to, or another process works there.
    """
    out = Path(out)
    require_usable(out, marker, resume=resume, force=force)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with _locked(out) if alone else nullcontext():
            if not resume:
                _empty(out)
            yield out
    except OSError as error:
        raise CpunetError(
            f"{out}: cannot be written ({error.strerror or error}); what is finished is kept, "
            "go on with --resume"
        ) from error


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a mapping, whole or not at all; numbers that are not finite become null."""
    text = json.dumps(_plain(content), indent=2, allow_nan=False, ensure_ascii=False)
    with written_aside(path) as aside:
        aside.write_text(text + "\n", encoding="utf-8")


def read_json(path: Path) -> dict[str, Any] | None:
    """Read a mapping; None if there is no such file.

    Raises
    ------
    CpunetError
        If it cannot be read or is no mapping.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise CpunetError(f"{path}: cannot be read ({reason}); remove it") from error
    if not isinstance(content, dict):
        raise CpunetError(f"{path}: damaged (no mapping); remove it")
    return content


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    with (folder / _LOCK).open("a") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise CpunetError(
                f"{folder}: another process is working there; wait for it, or choose "
                "another --out"
            ) from error
        except OSError:
            pass  # a file system without locks
        yield


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
