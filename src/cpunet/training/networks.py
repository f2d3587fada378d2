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
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from cpunet.electronics.measured import trace_noise
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
from cpunet.progress import stage
from cpunet.pulses.loading import InputSet
from cpunet.recipes.schema import Recipe
from cpunet.settings import flat
from cpunet.training.cyclegan import CycleGan, Outside
from cpunet.training.loop import State, discriminators_noted, train
from cpunet.training.run import LOSSES, RUN, FitInfo, Record, Run, read_losses

if TYPE_CHECKING:
    from cpunet.training.job import TrainingJob

log = logging.getLogger(__name__)

FORMAT = 4
MARKER, CHECKPOINT, ASIDE = "unfinished.json", "checkpoint.pt", ".checkpoint.partial"
UNFINISHED = FolderKind(
    name="unfinished run",
    command="cpunet train",
    own=rf"{RUN.own}|unfinished\.json|checkpoint\.pt|\.[^/]*\.partial.*",
)
# settings of logs and checkpoints, which do not affect the weights
_CHANGES_NOTHING = {"log_interval", "checkpoint_interval"}


def train_networks(job: TrainingJob) -> Run:
    """Train the networks of a CycleGAN, or resume their training."""
    recipe = job.recipe
    threads = torch.get_num_threads()  # as device and version, it changes the last bits
    environment = {"device": job.device, "threads": threads, "torch": torch.__version__}
    settings = recipe.model_dump(
        mode="json", exclude={"search": True, "training": _CHANGES_NOTHING}
    )
    run = UnfinishedRun(
        job.folder,
        {
            "recipe": settings,
            "peak": job.peak,
            "seed": job.seed,
            "init": None if job.init is None else job.init.weights_sha256,
            "simulation": job.sim.fingerprint(),
            "data": job.data.fingerprint(),
        },
        environment,
    )
    state = run.begin(resume=job.resume)
    outside, fit = outside_noise(job.sim, job.data, recipe)
    left = recipe.cyclegan.training.iterations - (state["iteration"] if state else 0)
    with stage("Training", left) as bar:

        def listen(records: list[Record]) -> None:
            run.log(records)
            bar.update(len(records))

        model = train(
            job.sim.prepared.pulses.waveforms,
            job.data.prepared.pulses.waveforms,
            recipe,
            seed=job.seed,
            device=job.device,
            init=None if job.init is None else weights_of(job.init, recipe),
            outside=outside,
            listener=listen,
            save=run.save,
            start=state,
        )
    run.finish()
    for line in discriminators_noted(read_losses(job.folder)):
        log.warning(line)
    resumed = {"resumed_at": run.resumed_at} if run.resumed_at else {}
    more: dict[str, Any] = resumed | ({} if fit is None else {"fit": fit})
    parts = dict(model.named_children()) | (
        {} if model.noise is None else {"noise": model.noise}
    )
    return job.run(parts, recipe, run.started, run.seconds, **more)


def outside_noise(
    sim: InputSet, data: InputSet, recipe: Recipe
) -> tuple[Outside | None, FitInfo | None]:
    """Noise for the translations of the simulated pulses, and what was found of tails.

    Raises
    ------
    CpunetError
        If the recipe requires noise, and there are no baselines to draw it from.
    """
    if recipe.cyclegan.training.noise == "none":
        return None, None
    try:
        noise, tails = trace_noise(data, recipe.preparation)
    except CpunetError as error:
        raise CpunetError(
            f"{data.path}: no baselines to draw noise from ({error}); or train "
            "without it (training.noise=none in `settings`)"
        ) from error
    outside = Outside(noise, sim.prepared.pulses.energy_kev, recipe.preparation)
    return outside, FitInfo(tails=tails)


def weights_of(init: Run, recipe: Recipe) -> Callable[[CycleGan], None]:
    """Function that fills networks for which another run has weights, at least REN and IREN.

    Raises
    ------
    CpunetError
        If that run has no networks, or they were trained on other windows.
    """
    other = init.recipe
    if other.generator.name != "punet":
        raise CpunetError(
            f"{init.name}: a readout chain ({other.name}), from which no network can start; "
            "give a run of networks"
        )
    theirs, own = other.preparation, recipe.preparation
    if (theirs.length, theirs.samples_before) != (own.length, own.samples_before):
        raise CpunetError(
            f"{init.name}: its networks know windows of {theirs.samples_before} + "
            f"{theirs.samples_after} samples, this recipe has {own.samples_before} + "
            f"{own.samples_after}; start from a run of the same windows"
        )

    def fill(model: CycleGan) -> None:
        there = {"ren", "iren"} | {name.partition(".")[0] for name in init.weights}
        device = str(next(model.parameters()).device)
        for name, network in model.named_children():
            if name in there:
                was_training = network.training
                init.fill(name, network, device).train(was_training)

    return fill


def unfinished_name(out: Path) -> Path:
    """Folder of the unfinished training that will become the run `out`."""
    return out.parent / f"{out.name}.unfinished"


@contextmanager
def unfinished_folder(
    out: Path, *inputs: Given, resume: bool = False, force: bool = False
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
            kept = "the training is kept, finish it with `resume`"
            raise CpunetError(f"{error}; {kept}") from error
        checkpoint.unlink(missing_ok=True)
    except OSError as error:
        raise CpunetError(
            f"{not_written(error, folder, folder)}; what is stored is kept, continue with "
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
        """Clear the folder, or find the state to continue from (None if there is none).

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
        told = {"started": self.started} | self._fingerprint | self._environment
        (self.folder / MARKER).write_text(json.dumps(told, indent=2) + "\n")
        return state

    def log(self, records: Iterable[Record]) -> None:
        """Add training records to the log; if the disk is full, they wait for a later call."""
        self._waiting += (json.dumps(record) + "\n" for record in records)
        with suppress(OSError):  # `save` reports it
            self.finish()

    def save(self, state: State) -> None:
        """Store a checkpoint; if that fails, report it and keep the previous one."""
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
                f"({error.strerror or error}); the one before is kept"
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
