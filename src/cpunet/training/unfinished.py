"""Training of networks on its way: ``RUN.unfinished``, next to the run that it becomes.

``unfinished.json``
    Recipe, seed and pulses, for information.
``losses.jsonl``
    The log of the losses, cut to the checkpoint's iteration when a training is resumed.
``checkpoint.pt``
    All that the next iterations depend on, replaced as a whole; reading it executes nothing.

The folder is visible, so that nobody wonders where a day of GPU time went.
"""

from __future__ import annotations

import io
import json
import logging
import os
import pickle
import signal
import threading
import time
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any, Self

import torch

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
from cpunet.settings import flat
from cpunet.training.run import LOSSES, RUN, Record

log = logging.getLogger(__name__)

FORMAT = 4
MARKER, CHECKPOINT, ASIDE = "unfinished.json", "checkpoint.pt", ".checkpoint.partial"
UNFINISHED = FolderKind(
    name="unfinished run",
    command="cpunet train",
    own=rf"{RUN.own}|unfinished\.json|checkpoint\.pt|\.[^/]*\.partial.*",
)
State = dict[str, Any]  # of a training: tensors, numbers and text, with its "iteration"


def unfinished_name(out: Path) -> Path:
    """Folder of the unfinished training that will become the run `out`."""
    return out.parent / f"{out.name}.unfinished"


@contextmanager
def unfinished_folder(
    out: Path, *inputs: Given, resume: bool = False, force: bool = False
) -> Iterator[Path]:
    """Provide ``OUT.unfinished`` as a working folder; its content at the end becomes `out`.

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
        Replace an existing run folder, and allow an unfinished training to be replaced.

    Raises
    ------
    CpunetError
        If `out` exists and may not be replaced, an unfinished training exists and is neither
        to be resumed nor replaced, or the folder cannot be written to.
    """
    refuse_existing(out, *inputs, force=force)
    require_replaceable(out, RUN)
    folder = unfinished_name(out)
    refuse_inputs(folder, *inputs)
    require_kind(folder, UNFINISHED)
    checkpoint = folder / CHECKPOINT
    try:
        folder.mkdir(parents=True, exist_ok=True)
        mark(folder, UNFINISHED, listed=False)
        if checkpoint.exists() and not (resume or force):
            raise CpunetError(
                f"{folder}: an unfinished training; continue with `resume`, or begin again "
                "with `force`"
            )
        yield folder
        # a copy: until it is in place, the training can be resumed from the original folder
        try:
            with folder_written_aside(out, RUN, force=force) as whole:
                copy_own(folder, whole, RUN)
        except CpunetError as error:
            remedy = "the training is stored, finish it with `resume`"
            raise CpunetError(f"{error}; {remedy}") from error
        checkpoint.unlink(missing_ok=True)
    except OSError as error:
        raise CpunetError(
            f"{not_written(error, folder, folder)}; what is stored remains, continue with "
            "`resume`"
        ) from error
    finally:
        if not checkpoint.exists():
            remove_own(folder, UNFINISHED)


class UnfinishedRun:
    """Log and checkpoint of a training in its folder.

    Parameters
    ----------
    folder
        From `unfinished_folder`.
    fingerprint
        Everything that determines the weights, by kind (``"recipe"``, ``"seed"``, …).
    environment
        Facts that may change their last bits: device, threads, version.
    """

    def __init__(
        self, folder: Path, fingerprint: dict[str, Any], environment: dict[str, Any]
    ) -> None:
        self.folder = folder
        self.started = datetime.now(UTC).isoformat(timespec="seconds")
        self.resumed_at: list[int] = []
        # as a file has it: no tuples, and no subclass of a number or a text
        self._fingerprint, self._environment = json.loads(
            json.dumps([{"format": FORMAT} | fingerprint, environment])
        )
        self._waiting: list[str] = []  # lines of the log, which has so many bytes before them
        self._logged = 0
        self._seconds_before = 0.0
        self._clock = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time taken so far, without lost iterations and pauses."""
        return self._seconds_before + time.perf_counter() - self._clock

    def begin(self, *, resume: bool) -> State | None:
        """Clear the folder, or find the state to continue from, or None.

        Raises
        ------
        CpunetError
            If the training was begun with other settings or pulses, or the checkpoint is
            damaged.
        """
        path, state = self.folder / CHECKPOINT, None
        if resume and path.exists():
            try:
                # torch writes checksums, but does not read them
                with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as parts:
                    if part := parts.testzip():
                        raise zipfile.BadZipFile(part)
                then = torch.load(path, map_location="cpu", weights_only=True)
            except (zipfile.BadZipFile, RuntimeError, ValueError, EOFError, pickle.PickleError):
                raise CpunetError(f"{path}: damaged; begin again with `force`") from None
            for kind, now in self._fingerprint.items():
                for difference in differences(then["fingerprint"].get(kind), now):
                    raise CpunetError(
                        f"resumed with another {kind}: {difference}; give what the training "
                        "was begun with, or begin again with `force`"
                    )
            for difference in differences(then["environment"], self._environment):
                log.warning(f"resumed elsewhere: {difference}; the last bits may differ")
            state = then["state"]
            self.started, self._seconds_before = then["started"], then["seconds"]
            self.resumed_at = [*then["resumed_at"], state["iteration"]]
            self._logged = then["logged"]
            log.info(f"going on after {state['iteration']} iterations")
        else:
            if resume:
                log.info("no checkpoint to go on from; beginning at the beginning")
            path.unlink(missing_ok=True)
        with (self.folder / LOSSES).open("ab") as stream:
            stream.truncate(self._logged)
        facts = {"started": self.started} | self._fingerprint | self._environment
        (self.folder / MARKER).write_text(json.dumps(facts, indent=2) + "\n")
        return state

    def log(self, records: Iterable[Record]) -> None:
        """Add training records to the log; if the disk is full, they wait for a later call."""
        self._waiting += (json.dumps(record) + "\n" for record in records)
        with suppress(OSError):  # `save` reports it
            self.finish()

    def save(self, state: State) -> None:
        """Store a checkpoint; if that fails, report it and keep the previous checkpoint."""
        aside = self.folder / ASIDE
        try:
            self.finish()
            stream = io.BytesIO()
            content = {
                "state": state,
                "fingerprint": self._fingerprint,
                "environment": self._environment,
                "started": self.started,
                "seconds": self.seconds,
                "resumed_at": self.resumed_at,
                "logged": self._logged,
            }
            torch.save(content, stream)
            with aside.open("wb") as file:
                file.write(stream.getbuffer())
                file.flush()
                os.fsync(file.fileno())
            aside.replace(self.folder / CHECKPOINT)
        except OSError as error:
            aside.unlink(missing_ok=True)  # free the space on a full disk
            log.warning(
                f"{self.folder}: no checkpoint after {state['iteration']} iterations "
                f"({error.strerror or error}); the previous remains"
            )

    def finish(self) -> None:
        """Write the rest of the log.

        Raises
        ------
        OSError
            If it cannot be written; the next call writes it in the same place.
        """
        content = "".join(self._waiting).encode()
        with (self.folder / LOSSES).open("r+b") as stream:
            stream.seek(self._logged)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        self._logged += len(content)
        self._waiting.clear()


def differences(then: Any, now: Any) -> Iterator[str]:
    """Each difference between two JSON-like values, as ``"training.batch_size 32 → 16"``."""
    # as read back from a file: without tuples
    old, new = (dict(flat(json.loads(json.dumps(value)))) for value in (then, now))
    for key in old | new:
        before, after = old.get(key, "none"), new.get(key, "none")
        if before != after:
            yield f"{key} {_short(before)} → {_short(after)}".strip()


def _short(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 24 else f"{text[:12]}…"


class Interruption:
    """Ctrl-C and SIGTERM wait for the end of an iteration; a second signal acts at once."""

    def __init__(self) -> None:
        self.signal = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # others get no signals
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, number: int, _frame: FrameType | None) -> None:
        self.__exit__()
        self.signal = number
        log.info("stopping after this iteration; once more to stop at once")

    def act(self, text: str) -> None:
        """Act now, after a signal, if all is stored."""
        if self.signal:
            log.info(text)
            signal.raise_signal(self.signal)


def state_of(game: Any) -> State:
    """All that the next iterations of a training depend on, except pulses and settings."""
    return {
        "iteration": game.iteration,
        "right": dict(game.right),
        "random": [torch.get_rng_state(), *torch.cuda.get_rng_state_all()],
        "parts": {name: part.state_dict() for name, part in game.parts.items()},
    }


def restore(game: Any, state: State | None) -> None:
    """Continue a training of the same pulses and settings from a state, if any."""
    if state is None:
        return
    game.iteration, game.right = state["iteration"], dict(state["right"])
    for name, part in game.parts.items():
        part.load_state_dict(state["parts"][name])
    torch.set_rng_state(state["random"][0])
    if torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["random"][1:])
