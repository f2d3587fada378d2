"""A folder of trainings that differ only in their seed.

``ensemble.json``
    Common settings, and the outcome of each seed; rewritten after each seed.
``seed_000``, ``seed_001``, …
    Run folders; with ``metrics.json`` if they were scored.
``seed_002.unfinished``
    A training that can be resumed, see `cpunet.training.unfinished`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from cpunet.errors import CpunetError
from cpunet.file_locks import locked
from cpunet.outputs import (
    MARKER,
    FolderKind,
    Given,
    mark,
    not_written,
    refuse_inputs,
    remove_own,
    require_kind,
    require_replaceable,
    written_aside,
)
from cpunet.regular_files import read_text
from cpunet.training.checkpoints import require_same
from cpunet.training.run_folder import INFO, RUN
from cpunet.training.unfinished import UNFINISHED
from cpunet.yaml_files import MAX_BYTES, plain_json

ENSEMBLE = "ensemble.json"
_LOCK = ".lock"
_MEMBER = rf"({RUN.own}|{UNFINISHED.own}|{re.escape(MARKER)})"
ENSEMBLE_KIND = FolderKind(
    name="ensemble",
    command="cpunet ensemble",
    known_by=ENSEMBLE,
    own=rf"ensemble\.json|seeds\.png|\.lock|\.seed_\d.*|seed_\d+(\.unfinished)?(/{_MEMBER})?",
)


def member_folder(ensemble: Path, seed: int) -> Path:
    """The run folder of a seed."""
    return Path(ensemble) / f"seed_{seed:03d}"


def finished_members(ensemble: Path) -> list[Path]:
    """Run folders of the finished seeds, in order of the seed.

    Raises
    ------
    CpunetError
        If there is none.
    """
    found = [path.parent for path in Path(ensemble).glob(f"seed_*/{INFO}")]
    # not what a process left that was stopped while it put a run in place
    runs = [run for run in found if re.fullmatch(r"seed_\d+", run.name)]
    if not runs:
        raise CpunetError(
            f"{ensemble}: no folder of an ensemble with a finished seed; make one with "
            "`cpunet ensemble`"
        )
    return sorted(runs, key=lambda run: (len(run.name), run.name))


def require_usable(
    out: Path, kind: FolderKind, *inputs: Given, resume: bool, force: bool
) -> None:
    """Raise a `CpunetError` if `out` exists and can be neither resumed nor replaced."""
    out = Path(out)
    refuse_inputs(out, *inputs)
    if out.exists() and not (resume or force):
        raise CpunetError(
            f"{out}: exists already; continue with --resume, or choose another name or --force"
        )
    left = {path.name for path in out.iterdir()} if out.is_dir() else set()
    if left != {_LOCK}:  # left by a process that was stopped before it began
        (require_kind if resume else require_replaceable)(out, kind)


@contextmanager
def working_folder(
    out: Path,
    kind: FolderKind,
    *,
    resume: bool = False,
    force: bool = False,
    alone: bool = True,
) -> Iterator[Path]:
    """Provide a working folder that is kept, whatever happens.

    Parameters
    ----------
    out
        The folder.
    kind
        Kind of the folder; folders of other kinds are never replaced.
    resume
        Continue in an existing folder.
    force
        Without `resume`, remove what the program wrote in an existing folder.
    alone
        Lock out other processes.

    Raises
    ------
    CpunetError
        As in `require_usable`, or if `out` cannot be written to or another process uses it.
    """
    out = Path(out)
    require_usable(out, kind, resume=resume, force=force)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with _locked(out) if alone else nullcontext():
            if not resume:
                remove_own(out, kind)
                out.mkdir(exist_ok=True)
            mark(out, kind, listed=False)
            yield out
    except OSError as error:
        raise CpunetError(
            f"{not_written(error, out, out)}; what is finished is kept, continue with --resume"
        ) from error


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a mapping, completely or not at all; non-finite numbers become null."""
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
        content = plain_json(read_text(path, MAX_BYTES))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise CpunetError(f"{path}: cannot be read ({reason}); remove it") from error
    if not isinstance(content, dict):
        raise CpunetError(f"{path}: damaged (no mapping); remove it")
    return content


class _Seed(BaseModel):
    """Outcome of a seed."""

    state: Literal["trained", "failed"]
    reason: str | None = None


class _Study(BaseModel):
    """Stored state of an ensemble or search that is resumed."""

    begun_with: dict[str, Any]
    seeds: dict[Annotated[str, Field(pattern=r"^[0-9]{1,9}$")], _Seed] = {}


def read_study(path: Path, begun_with: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read the stored state of a study; None if it was not begun.

    Raises
    ------
    CpunetError
        If the file was damaged, or the study begun with other settings or pulses.
    """
    content = read_json(path)
    if content is None:
        return None
    try:
        _Study.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        key = ".".join(map(str, first["loc"]))
        raise CpunetError(
            f"{path}: damaged ({key}: {first['msg']}); begin again with --force"
        ) from error
    require_same(content["begun_with"], begun_with)
    return content


def _locked(folder: Path) -> AbstractContextManager[None]:
    """Lock out other processes."""
    busy = f"{folder}: another process is working there; wait for it, or choose another --out"
    return locked(folder / _LOCK, busy)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
