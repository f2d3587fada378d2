"""Two files in, a run folder with trained networks out."""

from __future__ import annotations

import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cpunet.errors import CpunetError
from cpunet.files import folder_written_aside
from cpunet.jobs.inputs import (
    InputFile,
    InputSet,
    load_measured,
    load_simulated,
    require_same_sampling,
)
from cpunet.jobs.matching import Sides, match
from cpunet.jobs.monitor import Monitor
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import MatchingConfig, Recipe
from cpunet.training.loop import Keeping, Record, train
from cpunet.training.run_folder import (
    INFO,
    append_losses,
    fill_networks,
    read_info,
    read_losses,
    versions,
    weights_sha256,
    write_run,
)
from cpunet.training.tensorboard import LossBoard
from cpunet.training.unfinished import UnfinishedRun, unfinished_folder

QUIET = Monitor()
# of a recipe, what says when to tell and to store, and changes no weight
_CHANGES_NOTHING = {"log_interval", "checkpoint_interval"}


def train_run(
    sim: InputFile,
    data: InputFile,
    out: Path,
    recipe: Recipe,
    *,
    peak: str = "FEP",
    seed: int = 0,
    device: str = "auto",
    init: Path | None = None,
    resume: bool = False,
    force: bool = False,
    tensorboard: bool = False,
    stop: Callable[[], bool] = lambda: False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Train REN and IREN on the pulses of a peak and write the run folder.

    Parameters
    ----------
    sim, data
        Simulated and measured pulses.
    out
        The run folder; it appears when the training is done. A CycleGAN works in
        ``OUT.unfinished`` until then, see `cpunet.training.unfinished`.
    recipe
        All settings.
    peak
        Energies to train on: a peak of the recipe or a range in keV.
    seed
        Of everything random.
    device
        ``"cpu"``, ``"cuda"``, or ``"auto"`` for the GPU if there is one.
    init
        Folder of a run of the same kind to start from, as of another detector or period.
    resume
        Go on with the unfinished training, if there is one; all else must be as it was.
    force
        Replace an existing folder and, without `resume`, an unfinished training.
    tensorboard
        Write TensorBoard logs beside the losses (needs the extra ``tensorboard``).
    stop
        Asked after each iteration of a CycleGAN whether to store its state and stop.
    monitor
        Told of the progress.

    Returns
    -------
    dict
        The content of ``run.json``.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, there is an unfinished training of
        another kind, the memory does not suffice, or the training diverges.
    StoppedError
        If `stop` asked for it.
    """
    device = resolve_device(device)
    selection = parse_selection(peak, recipe.peaks)
    with _workplace(out, recipe, resume=resume, force=force) as folder:
        sim_set = load_simulated(sim, recipe, selection, monitor)
        data_set = load_measured(data, recipe, selection, monitor)
        require_same_sampling(sim_set, data_set)
        if init is not None:
            _require_sampling(init, data_set)
        sides = sim_set, data_set, data
        job = _Job(recipe, peak, seed, device, init, *sides, folder, monitor)
        with _enough_memory(recipe):
            if isinstance(recipe.training, MatchingConfig):
                model, info, recipe = job.match(tensorboard)
            else:
                model, info = job.train(resume, tensorboard, stop)
        write_run(folder, model, recipe, info)
    return info


def _workplace(
    out: Path, recipe: Recipe, *, resume: bool, force: bool
) -> AbstractContextManager[Path]:
    if not isinstance(recipe.training, MatchingConfig):
        return unfinished_folder(out, resume=resume, force=force)
    if resume:
        raise CpunetError(
            f"recipe {recipe.name}: takes a minute and keeps no checkpoints; give the recipe "
            "that the training was begun with, or leave out --resume"
        )
    return folder_written_aside(out, marker=INFO, force=force)


def _require_sampling(init: Path, data: InputSet) -> None:
    """Raise a `CpunetError` if the run to start from had another sampling."""
    known_ns = float(read_info(init)["dt_ns"])
    if not np.isclose(known_ns, data.dt_ns):
        raise CpunetError(
            f"{init}: trained on {known_ns:g} ns, these pulses have {data.dt_ns:g} ns; "
            "resample them"
        )


@dataclass(frozen=True, eq=False)
class _Job:
    """What is to be trained, on what and where."""

    recipe: Recipe
    peak: str
    seed: int
    device: str
    init: Path | None
    sim: InputSet
    data: InputSet
    data_file: InputFile
    folder: Path
    monitor: Monitor

    def match(self, tensorboard: bool) -> tuple[nn.Module, dict[str, Any], Recipe]:
        """Match a response; return it, the content of ``run.json``, and its recipe."""
        started, clock = datetime.now(UTC), time.perf_counter()
        sides = Sides(self.sim.prepared.pulses, self.data.prepared.pulses, self.data_file)
        with (
            _losses_shown(self.folder, wanted=tensorboard) as show,
            self.monitor.stage("Matching") as advance,
        ):

            def listen(records: list[Record]) -> None:
                append_losses(self.folder, records)
                show(records)
                advance(len(records))

            model, more, recipe = match(
                sides, self.recipe, self.seed, listen, self.monitor, self.init
            )
        seconds = time.perf_counter() - clock
        info = self._info(started.isoformat(timespec="seconds"), seconds)
        return model, info | more, recipe

    def train(
        self, resume: bool, tensorboard: bool, stop: Callable[[], bool]
    ) -> tuple[nn.Module, dict[str, Any]]:
        """Train a CycleGAN, or go on; return it and the content of ``run.json``."""
        run = UnfinishedRun(
            self.folder, self._fingerprint(), self._environment(), self.monitor.note
        )
        start = run.begin(resume=resume)
        left = self.recipe.training.iterations - (start["iteration"] if start else 0)
        with (
            _losses_shown(self.folder, wanted=tensorboard) as show,
            self.monitor.stage("Training", left) as advance,
        ):

            def listen(records: list[Record]) -> None:
                run.log(records)
                show(records)
                advance(len(records))

            model = train(
                self.sim.prepared.pulses.waveforms,
                self.data.prepared.pulses.waveforms,
                self.recipe,
                seed=self.seed,
                device=self.device,
                init=None if self.init is None else partial(fill_networks, self.init),
                listener=listen,
                keeping=Keeping(run.save, start, stop),
            )
        run.finish()
        resumed = {"resumed_at": run.resumed_at} if run.resumed_at else {}
        return model, self._info(run.started, run.seconds) | resumed

    def _fingerprint(self) -> dict[str, Any]:
        """All that determines the weights."""
        recipe = self.recipe.model_dump(mode="json")
        del recipe["search"]  # what may be tuned changes no weight
        training = recipe["training"]
        recipe["training"] = {k: v for k, v in training.items() if k not in _CHANGES_NOTHING}
        told = ("dt_ns", "used", "sha256")  # not the name: a file may have been moved
        sides = (("simulation", self.sim), ("data", self.data))
        settings = {"recipe": recipe, "peak": self.peak, "seed": self.seed}
        if self.init is not None:
            settings["init"] = weights_sha256(self.init)
        return settings | {
            side: {k: v for k, v in pulses.provenance().items() if k in told}
            for side, pulses in sides
        }

    def _environment(self) -> dict[str, Any]:
        """What the last bits depend on."""
        return {
            "device": self.device,
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
        }

    def _info(self, started: str, seconds: float) -> dict[str, Any]:
        return {
            "recipe": self.recipe.name,
            "peak": self.peak,
            "seed": self.seed,
            "init": None if self.init is None else str(self.init),
            "device": self.device,
            "threads": torch.get_num_threads(),
            "started": started,
            "seconds": round(seconds, 1),
            "peak_memory_mb": _peak_memory_mb(self.device),
            "dt_ns": self.data.dt_ns,
            "versions": versions(),
            "sim": self.sim.provenance(),
            "data": self.data.provenance(),
        }


@contextmanager
def _losses_shown(folder: Path, *, wanted: bool) -> Iterator[Callable[[list[Record]], None]]:
    """Give what takes records to TensorBoard, if that is wanted; it has those of the log."""
    if not wanted:
        yield lambda _records: None
        return
    shutil.rmtree(folder / "tensorboard", ignore_errors=True)  # of iterations done again
    board = LossBoard(folder)
    try:
        board.add(read_losses(folder))
        yield board.add
    finally:
        board.close()


@contextmanager
def _enough_memory(recipe: Recipe) -> Iterator[None]:
    """Turn an exhausted memory into a line that says which batch size to try."""
    try:
        yield
    except (torch.cuda.OutOfMemoryError, MemoryError, RuntimeError) as error:
        # the CPU's allocator has no error of its own
        known = isinstance(error, torch.cuda.OutOfMemoryError | MemoryError)
        if not (known or "DefaultCPUAllocator" in str(error)):
            raise
        where = "GPU" if isinstance(error, torch.cuda.OutOfMemoryError) else "computer"
        if isinstance(recipe.training, MatchingConfig):
            remedy = f"--set training.max_pulses={max(100, recipe.training.max_pulses // 2)}"
        else:
            remedy = f"--set training.batch_size={max(2, recipe.training.batch_size // 2)}"
        raise CpunetError(f"the {where}'s memory does not suffice; try {remedy}") from error


def _peak_memory_mb(device: str) -> dict[str, float]:
    """The most memory of this process so far, and of its tensors on the GPU."""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    peak = {"host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit}
    if device.startswith("cuda"):
        peak["gpu"] = torch.cuda.max_memory_allocated(device) / 2**20
    return {where: round(mb, 1) for where, mb in peak.items()}


def resolve_device(device: str) -> str:
    """Turn ``"auto"`` into a device; refuse one that is not there."""
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise CpunetError("no GPU was found; use --device cpu or install a CUDA build of torch")
    if device != "cpu" and not device.startswith("cuda"):
        raise CpunetError(f"device {device!r} is not known; use cpu, cuda or auto")
    return device
