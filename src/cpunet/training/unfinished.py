"""An unfinished training: ``RUN.unfinished``, next to the run folder that it becomes.

``unfinished.json``
    Recipe, seed and pulses, for information; locked by the process that trains.
``losses.jsonl``
    The log of the losses, cut to the checkpoint's iteration when a training is resumed.
``checkpoint.safetensors``, ``checkpoint.previous.safetensors``
    See `cpunet.training.checkpoints`.

The folder is visible, so that nobody wonders where a day of GPU time went.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cpunet.errors import CpunetError
from cpunet.outputs import (
    FolderKind,
    Given,
    copy_own,
    folder_written_aside,
    mark,
    not_written,
    refuse_existing,
    refuse_inputs,
    remove_own,
    require_kind,
    require_replaceable,
)
from cpunet.training.checkpoints import (
    CHECKPOINT,
    Checkpoint,
    differences,
    has_checkpoint,
    read_checkpoints,
    remove_checkpoints,
    require_same,
    write_checkpoint,
)
from cpunet.training.loop import Record, State
from cpunet.training.run_folder import LOSSES, RUN

MARKER = "unfinished.json"
UNFINISHED = FolderKind(
    name="unfinished run",
    command="cpunet train",
    known_by=MARKER,
    own=rf"{RUN.own}|unfinished\.json|checkpoint(\.previous)?\.safetensors|\.[^/]*\.partial.*",
)


def unfinished_name(out: Path) -> Path:
    """Folder of the unfinished training that will become the run `out`."""
    return out.parent / f"{out.name}.unfinished"


@contextmanager
def unfinished_folder(
    out: Path,
    *inputs: Given,
    resume: bool = False,
    force: bool = False,
) -> Iterator[Path]:
    """Provide ``OUT.unfinished`` as a working folder; its content at the end becomes `out`.

    On an exception the folder is kept if it contains a checkpoint.

    Parameters
    ----------
    out
        Run folder to be made.
    inputs
        Files and folders that are read.
    resume
        Whether an unfinished training may exist; it is kept for `UnfinishedRun` to continue.
    force
        Replace an existing run folder, and allow an unfinished training to be replaced.

    Raises
    ------
    CpunetError
        If `out` exists and may not be replaced, an unfinished training exists and is neither
        to be resumed nor replaced, another process is training there, or the folder cannot
        be written to.
    """
    out = Path(out)
    refuse_existing(out, *inputs, force=force)
    require_replaceable(out, RUN)
    folder = unfinished_name(out)
    refuse_inputs(folder, *inputs)
    require_kind(folder, UNFINISHED)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder):
            mark(folder, UNFINISHED, listed=False)
            if has_checkpoint(folder) and not (resume or force):
                raise CpunetError(
                    f"{folder}: an unfinished training; continue with --resume, or begin again "
                    "with --force"
                )
            finished = False
            try:
                yield folder
                _put_in_place(folder, out, force=force)
                finished = True
            finally:
                if finished or not has_checkpoint(folder):
                    remove_own(folder, UNFINISHED)
    except OSError as error:
        raise CpunetError(
            f"{not_written(error, folder, folder)}; what is stored is kept, continue with "
            "--resume"
        ) from error


def _put_in_place(folder: Path, out: Path, *, force: bool) -> None:
    # a copy: until it is in place, the training can be resumed from the original folder
    try:
        with folder_written_aside(out, RUN, force=force) as whole:
            copy_own(folder, whole, RUN)
    except CpunetError as error:
        raise CpunetError(f"{error}; the training is kept, finish it with --resume") from error


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock out other processes, whose weights would be mixed with those of this one."""
    with (folder / MARKER).open("a") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CpunetError(
                f"{folder}: another process is training there; wait for it, or choose another "
                "--out"
            ) from None
        except OSError:
            pass
        yield


class UnfinishedRun:
    """Log and checkpoints of a training in its folder.

    Parameters
    ----------
    folder
        From `unfinished_folder`.
    fingerprint
        Everything that determines the weights, for `require_same`.
    environment
        Facts that may change their last bits: device, threads, version.
    note
        Called with messages for the user.
    """

    def __init__(
        self,
        folder: Path,
        fingerprint: dict[str, Any],
        environment: dict[str, Any],
        note: Callable[[str], None],
    ) -> None:
        self.folder = folder
        self.started = datetime.now(UTC).isoformat(timespec="seconds")
        self.resumed_at: list[int] = []
        self._fingerprint, self._environment = fingerprint, environment
        self._note = note
        self._log = LossLog(folder)
        self._seconds_before = 0.0
        self._clock = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time taken so far, without lost iterations and pauses."""
        return self._seconds_before + time.perf_counter() - self._clock

    def begin(self, *, resume: bool) -> State | None:
        """Clear the folder, or find the state to continue from (None if there is none).

        Raises
        ------
        CpunetError
            If the training was begun with other settings or pulses, or all its checkpoints
            are damaged.
        """
        checkpoint = self._latest() if resume else None
        if checkpoint is None:
            if resume:
                self._note("no checkpoint to go on from; beginning at the beginning")
            remove_checkpoints(self.folder)
            self._log.cut(0)
        else:
            self._take_up(checkpoint)
        told = {"started": self.started} | self._fingerprint | self._environment
        (self.folder / MARKER).write_text(json.dumps(told, indent=2) + "\n")
        return None if checkpoint is None else checkpoint.state

    def log(self, records: Iterable[Record]) -> None:
        """Add training records to the log; if the disk is full, they wait for a later call."""
        self._log.add(records)
        with suppress(OSError):  # `save` reports it
            self._log.write()

    def save(self, state: State) -> None:
        """Store a checkpoint; if that fails, report it and keep the previous one."""
        facts = {
            "fingerprint": self._fingerprint,
            "environment": self._environment,
            "started": self.started,
            "seconds": self.seconds,
            "resumed_at": self.resumed_at,
        }
        try:
            facts["log_bytes"] = self._log.write(sync=True)
            write_checkpoint(self.folder, Checkpoint(state, facts))
        except OSError as error:
            self._note(
                f"warning: {self.folder}: no checkpoint after {state['iteration']} "
                f"iterations ({error.strerror or error}); the one before is kept"
            )

    def finish(self) -> None:
        """Write the rest of the log.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        self._log.write(sync=True)

    def _latest(self) -> Checkpoint | None:
        damaged = 0
        for checkpoint in read_checkpoints(self.folder):
            if checkpoint is None or not _fits(checkpoint, self._log.length):
                damaged += 1
                continue
            if damaged:
                self._note(
                    f"warning: {self.folder / CHECKPOINT}: damaged; going on from the previous "
                    f"one, after {checkpoint.state['iteration']} iterations"
                )
            return checkpoint
        if damaged:
            raise CpunetError(
                f"{self.folder}: no checkpoint is whole; begin again with --force"
            )
        return None

    def _take_up(self, checkpoint: Checkpoint) -> None:
        facts, state = checkpoint.facts, checkpoint.state
        require_same(facts["fingerprint"], self._fingerprint)
        for difference in differences(facts["environment"], self._environment):
            self._note(f"warning: resumed elsewhere: {difference}; the last bits may differ")
        self.started, self._seconds_before = facts["started"], facts["seconds"]
        self.resumed_at = [*facts["resumed_at"], state["iteration"]]
        self._log.cut(facts["log_bytes"])
        self._note(f"going on after {state['iteration']} iterations")


def _fits(checkpoint: Checkpoint, log_bytes: int) -> bool:
    """Whether a checkpoint has all facts needed to resume, and the log is long enough."""
    facts: Any = checkpoint.facts
    known: dict[str, Any] = {"fingerprint": dict, "environment": dict, "started": str}
    known |= {"seconds": int | float, "resumed_at": list, "log_bytes": int}
    return (
        isinstance(facts, dict)
        and all(isinstance(facts.get(name), kind) for name, kind in known.items())
        and 0 <= facts["log_bytes"] <= log_bytes
        and isinstance(checkpoint.state, dict)
        and isinstance(checkpoint.state.get("iteration"), int)
    )


class LossLog:
    """``losses.jsonl``, without lost or duplicate lines if a write fails halfway."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / LOSSES
        self.length = self._path.stat().st_size if self._path.exists() else 0
        self._waiting: list[str] = []

    def cut(self, length: int) -> None:
        """Truncate the log to `length` bytes."""
        with self._path.open("ab") as stream:
            stream.truncate(length)
        self.length = length

    def add(self, records: Iterable[Record]) -> None:
        """Queue records, one line each, for the next `write`."""
        self._waiting += (json.dumps(record) + "\n" for record in records)

    def write(self, *, sync: bool = False) -> int:
        """Write the queued lines; return the length of the log in bytes.

        Raises
        ------
        OSError
            If it cannot be written; the next call writes it in the same place.
        """
        content = "".join(self._waiting).encode()
        with self._path.open("r+b") as stream:
            stream.seek(self.length)
            stream.write(content)
            stream.flush()
            if sync:
                os.fsync(stream.fileno())
        self.length += len(content)
        self._waiting.clear()
        return self.length
