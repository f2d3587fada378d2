"""Checkpoints: the state of a training as a file, verified and without pickle.

Tensors are stored as safetensors, everything else as JSON in their header, with a SHA-256 of
both.  A checkpoint is written to a temporary file, which then replaces the last one.  The last
one is kept as the previous one, so that one of the two is complete at any moment.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from cpunet.errors import CpunetError
from cpunet.training.loop import State

CHECKPOINT, PREVIOUS = "checkpoint.safetensors", "checkpoint.previous.safetensors"
FORMAT = 3
_ASIDE = ".checkpoint.partial"  # a fixed name: the file of a killed process is overwritten
_TENSOR = "tensor"
_ABSENT = "none"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The state of a training, and facts that identify the training."""

    state: State
    facts: dict[str, Any]


def has_checkpoint(folder: Path) -> bool:
    """Whether there is a checkpoint in a folder, readable or not."""
    return any((folder / name).exists() for name in (CHECKPOINT, PREVIOUS))


def remove_checkpoints(folder: Path) -> None:
    """Remove the checkpoints of a folder, if there are any."""
    for name in (_ASIDE, CHECKPOINT, PREVIOUS):
        (folder / name).unlink(missing_ok=True)


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Store a state; the one stored before becomes the previous one.

    Raises
    ------
    OSError
        If it cannot be written, for example on a full disk; the last checkpoint is kept.
    """
    tensors: dict[str, Tensor] = {}
    plain = _parted(checkpoint.state, "", tensors)
    text = json.dumps({"format": FORMAT, "facts": checkpoint.facts, "state": plain})
    metadata = {"json": text, "sha256": _digest(text, tensors)}
    aside = folder / _ASIDE
    try:
        _save_durably(aside, tensors, metadata)
        if (folder / CHECKPOINT).exists():
            (folder / CHECKPOINT).replace(folder / PREVIOUS)
        aside.replace(folder / CHECKPOINT)
    except OSError:
        aside.unlink(missing_ok=True)  # free the space on a full disk
        raise
    _sync_folder(folder)


def _save_durably(path: Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
    try:
        save_file(tensors, path, metadata)
    except SafetensorError as error:  # only the writing can fail here
        raise OSError(str(error)) from error
    with path.open("r+b") as stream:
        os.fsync(stream.fileno())


def read_checkpoints(folder: Path) -> Iterator[Checkpoint | None]:
    """Read the checkpoints of a folder, latest first; None for a damaged one.

    Raises
    ------
    CpunetError
        If one was written in another format.
    """
    for name in (CHECKPOINT, PREVIOUS):
        if (folder / name).exists():
            yield _read(folder / name)


def _read(path: Path) -> Checkpoint | None:
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata()
            # copies: an optimiser must not continue with views of the file
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        text = metadata["json"]
        if metadata["sha256"] != _digest(text, tensors):
            return None
        content = json.loads(text)
        made_by = content["format"]
        state, facts = _joined(content["state"], tensors), content["facts"]
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError):
        return None  # RecursionError is a RuntimeError
    if made_by != FORMAT:
        raise CpunetError(
            f"{path}: written by another version of cpunet; go on with that one, or begin "
            "again with --force"
        )
    return Checkpoint(state, facts)


def require_same(then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to resume with other settings or pulses.

    Parameters
    ----------
    then, now
        Everything that determines the weights, by kind (``"recipe"``, ``"seed"``, …): values,
        or nested mappings of values.

    Raises
    ------
    CpunetError
        If they differ; the message names the first difference.
    """
    for kind in now:
        for difference in differences(then.get(kind), now[kind]):
            raise CpunetError(
                f"resumed with another {kind}: {difference}; give what the training was begun "
                "with, or begin again with --force"
            )


def differences(then: Any, now: Any) -> Iterator[str]:
    """Each difference between two JSON-like values, as ``"training.batch_size 32 → 16"``."""
    # as read back from a file: without tuples
    old, new = (dict(_leaves("", json.loads(json.dumps(value)))) for value in (then, now))
    for key in old | new:
        before, after = old.get(key, _ABSENT), new.get(key, _ABSENT)
        if before != after:
            yield f"{key} {_short(before)} → {_short(after)}".strip()


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict):
        yield key, value
        return
    for name, part in value.items():
        yield from _leaves(f"{key}.{name}" if key else name, part)


def _short(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 24 else f"{text[:12]}…"


def _parted(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """Move the tensors of nested dicts and lists to `tensors`; return the rest, as JSON."""
    if isinstance(value, Tensor):
        tensors[name] = value.detach().cpu().contiguous()
        return {_TENSOR: name}
    if isinstance(value, Mapping):
        return {str(k): _parted(part, f"{name}.{k}", tensors) for k, part in value.items()}
    if isinstance(value, list | tuple):
        return [_parted(part, f"{name}.{k}", tensors) for k, part in enumerate(value)]
    return value


def _joined(value: Any, tensors: dict[str, Tensor]) -> Any:
    """Undo `_parted`."""
    if isinstance(value, dict):
        if value.keys() == {_TENSOR}:
            return tensors[value[_TENSOR]]
        return {key: _joined(part, tensors) for key, part in value.items()}
    if isinstance(value, list):
        return [_joined(part, tensors) for part in value]
    return value


def _digest(text: str, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().tobytes())
    return digest.hexdigest()


def _sync_folder(folder: Path) -> None:
    """Make the renames survive a power failure, if the file system supports it."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
