"""Training of networks on its way: ``RUN.unfinished``, next to the run that it becomes.

Its ``checkpoint.pt`` has all that the next iterations depend on, and the log so far.  It is
replaced as a whole; reading it executes nothing.  The folder is visible, so that nobody wonders
where a day of GPU time went.
"""

from __future__ import annotations

import io
import json
import logging
import pickle
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from cpunet.errors import CpunetError
from cpunet.outputs import (
    MARKER,
    FolderKind,
    Given,
    mark,
    not_written,
    refuse_existing,
    refuse_inputs,
    require_replaceable,
)
from cpunet.settings import flat
from cpunet.training.run import RUN, Record

log = logging.getLogger(__name__)

CHECKPOINT, ASIDE = "checkpoint.pt", ".checkpoint.partial"
UNFINISHED = FolderKind(
    name="unfinished run", command="cpunet train", own=r"checkpoint\.pt|\.checkpoint\.partial"
)
State = dict[str, Any]  # of a training: tensors, numbers and text, with its "iteration"


@contextmanager
def unfinished_folder(
    out: Path, *inputs: Given, resume: bool = False, force: bool = False
) -> Iterator[Path]:
    """Provide ``OUT.unfinished`` for checkpoints, and remove it when `out` is in place.

    On an exception the folder stays if it contains a checkpoint.

    Parameters
    ----------
    out
        Run folder to be made.
    inputs
        Files and folders that are read.
    resume
        Whether an unfinished training may exist; it stays for `UnfinishedRun` to continue.
    force
        Allow an existing run, and an unfinished training, to be replaced.

    Raises
    ------
    CpunetError
        If `out` exists and may not be replaced, an unfinished training exists and is neither
        to be resumed nor replaced, or the folder cannot be written to.
    """
    refuse_existing(out, *inputs, force=force)
    require_replaceable(out, RUN)
    folder = out.parent / f"{out.name}.unfinished"
    refuse_inputs(folder, *inputs)
    require_replaceable(folder, UNFINISHED)
    checkpoint = folder / CHECKPOINT
    if checkpoint.exists() and not (resume or force):
        raise CpunetError(
            f"{folder}: an unfinished training; continue with `resume`, or begin again "
            "with `force`"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        mark(folder, UNFINISHED)
    except OSError as error:
        raise not_written(error, folder, folder) from error
    try:
        yield folder
        checkpoint.unlink(missing_ok=True)
    finally:
        if not checkpoint.exists():
            for name in (ASIDE, MARKER):
                (folder / name).unlink(missing_ok=True)
            with suppress(OSError):  # somebody's files are in it
                folder.rmdir()


class UnfinishedRun:
    """Log and checkpoint of a training.

    Parameters
    ----------
    folder
        From `unfinished_folder`; None for a training that leaves no checkpoint.
    fingerprint
        Everything that determines the weights, by kind (``"recipe"``, ``"seed"``, …).
    resume
        Whether to continue from a checkpoint, if the folder has one.

    Attributes
    ----------
    state
        To continue from, or None.

    Raises
    ------
    CpunetError
        If the training was begun with other settings or pulses, or the checkpoint is damaged.
    """

    state: State | None = None

    def __init__(
        self, folder: Path | None, fingerprint: dict[str, Any], *, resume: bool = False
    ) -> None:
        self.folder = folder
        self.started = datetime.now(UTC).isoformat(timespec="seconds")
        self.resumed_at: list[int] = []
        self.records: list[Record] = []
        # as a file has it: no tuples, and no subclass of a number or a text
        self._fingerprint = json.loads(json.dumps(fingerprint))
        self.clock = time.perf_counter()  # less the time before, without lost iterations
        if not resume or folder is None:
            return
        path = folder / CHECKPOINT
        if not path.exists():
            log.info("no checkpoint to go on from; beginning at the beginning")
            return
        try:
            then = torch.load(path, map_location="cpu", weights_only=True)
        except (RuntimeError, ValueError, EOFError, pickle.PickleError):
            raise CpunetError(f"{path}: damaged; begin again with `force`") from None
        for kind, now in self._fingerprint.items():
            for difference in differences(then["fingerprint"].get(kind), now):
                raise CpunetError(
                    f"resumed with another {kind}: {difference}; give what the training "
                    "was begun with, or begin again with `force`"
                )
        self.state = state = then["state"]
        self.started, self.records = then["started"], then["records"]
        self.resumed_at = [*then["resumed_at"], state["iteration"]]
        self.clock -= then["seconds"]
        log.info(f"going on after {state['iteration']} iterations")

    def save(self, state: State) -> None:
        """Store a checkpoint; if that fails, report it, and the previous checkpoint stays."""
        if self.folder is None:
            return
        content = {"state": state, "fingerprint": self._fingerprint, "records": self.records}
        content |= {"started": self.started, "resumed_at": self.resumed_at}
        content["seconds"] = time.perf_counter() - self.clock
        torch.save(content, stream := io.BytesIO())
        aside = self.folder / ASIDE
        try:
            aside.write_bytes(stream.getbuffer())
            aside.replace(self.folder / CHECKPOINT)
        except OSError as error:
            aside.unlink(missing_ok=True)  # free the space on a full disk
            log.warning(
                f"{self.folder}: no checkpoint after {state['iteration']} iterations "
                f"({error.strerror or error}); the previous remains"
            )


def differences(then: Any, now: Any) -> Iterator[str]:
    """Each difference between two JSON-like values, as ``"training.batch_size 32 → 16"``."""
    # as read back from a file: without tuples
    old, new = (dict(flat(json.loads(json.dumps(value)))) for value in (then, now))
    for key in old | new:
        before, after = (values.get(key, "none") for values in (old, new))
        if before != after:
            texts = (" ".join(str(value).split()) for value in (before, after))
            short = (f"{text[:12]}…" if len(text) > 24 else text for text in texts)
            yield f"{key} {' → '.join(short)}".strip()


@contextmanager
def waiting_signals() -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM wait in a list for the end of an iteration; a second acts at once."""
    waiting, before = list[int](), dict[int, Any]()

    def take(number: int, _frame: FrameType | None) -> None:
        for own, handler in before.items():
            signal.signal(own, handler)
        waiting.append(number)
        log.info("stopping after this iteration; once more to stop at once")

    if threading.current_thread() is threading.main_thread():  # others get no signals
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, take)
    try:
        yield waiting
    finally:
        for own, handler in before.items():
            signal.signal(own, handler)
