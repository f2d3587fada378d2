"""Two files in, a run folder with trained networks out."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cpunet.errors import CpunetError
from cpunet.files import folder_written_aside
from cpunet.jobs.common.devices import enough_memory, peak_memory_mb
from cpunet.jobs.common.inputs import (
    InputFile,
    InputSet,
    load_measured,
    load_simulated,
    require_both_sides,
    require_same_sampling,
)
from cpunet.jobs.common.memory import keep_freed_memory
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.training.check import Level, compare_sides
from cpunet.jobs.training.matching import Sides, known_response, match
from cpunet.jobs.training.network_start import NetworkStart, network_start
from cpunet.jobs.training.train_team import team_for
from cpunet.networks.response import ElectronicsResponse
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.recipes.training_settings import MatchingConfig
from cpunet.training.held_out import Kept
from cpunet.training.judges import judges_noted
from cpunet.training.loop import CheckpointHooks, Listener, Record, train
from cpunet.training.network_gate import NetworkGate
from cpunet.training.run_folder import (
    RUN,
    append_losses,
    read_info,
    read_losses,
    versions,
    weights_sha256,
    write_run,
)
from cpunet.training.team import Team
from cpunet.training.team_state import require_same_everywhere, share_state
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

    Processes that torchrun started train one CycleGAN together; the one of rank 0 writes.

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
        ``"cpu"``, ``"cuda"`` (a GPU each), or ``"auto"`` for the GPU if there is one.
    init
        Folder of a run to start from, as of another detector or period: of the same kind, or
        a matched one, which makes pairs for networks to learn first.
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
        The content of ``run.json``; empty in a process that did not write it.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, there is an unfinished training of
        another kind, memory does not suffice, the training diverges or another process fails.
    StoppedError
        If `stop` asked for it.
    """
    keep_freed_memory()
    with team_for(recipe, device) as (team, device):
        selection = parse_selection(peak, recipe.peaks)
        told = monitor if team.leads else QUIET
        read = (*sim.files, *data.files, init)
        with _workplace(out, read, recipe, team, told, resume=resume, force=force) as folder:
            sim_set = load_simulated(sim, recipe, selection, told)
            data_set = load_measured(data, recipe, selection, told)
            require_same_sampling(sim_set, data_set)
            for note in require_both_sides(sim_set, data_set, selection):
                told.note(note)
            for finding in compare_sides(sim_set, data_set, selection):
                if finding.level != Level.FINE:
                    told.note(f"warning: {finding}")
            if init is not None:
                _require_sampling(init, data_set)
            sides = sim_set, data_set, data
            job = TrainingJob(recipe, peak, seed, device, team, init, *sides, folder, told)
            with enough_memory(recipe, team.size):
                if isinstance(recipe.training, MatchingConfig):
                    model, info, recipe = job.match(tensorboard)
                elif team.leads:
                    model, info, recipe = job.train(resume, tensorboard, stop)
                else:
                    job.help_train(stop)
                    return {}
            return write_run(folder, model, recipe, info)


def _workplace(
    out: Path,
    read: Sequence[Path | str | None],
    recipe: Recipe,
    team: Team,
    monitor: Monitor,
    *,
    resume: bool,
    force: bool,
) -> AbstractContextManager[Path]:
    if not team.leads:  # another process writes there
        return nullcontext(out)
    if not isinstance(recipe.training, MatchingConfig):
        return unfinished_folder(out, *read, resume=resume, force=force, note=monitor.note)
    if resume:
        raise CpunetError(
            f"recipe {recipe.name}: takes a minute and keeps no checkpoints; give the recipe "
            "that the training was begun with, or leave out --resume"
        )
    return folder_written_aside(out, RUN, *read, force=force, note=monitor.note)


def _require_sampling(init: Path, data: InputSet) -> None:
    """Raise a `CpunetError` if the run to start from had another sampling."""
    known_ns = float(read_info(init)["dt_ns"])
    if not np.isclose(known_ns, data.dt_ns):
        kinds = f"trained on {known_ns:g} ns, these pulses have {data.dt_ns:g} ns"
        raise CpunetError(f"{init}: {kinds}; resample them")


@dataclass(frozen=True, eq=False)
class TrainingJob:
    """What is to be trained, on what and where."""

    recipe: Recipe
    peak: str
    seed: int
    device: str
    team: Team
    init: Path | None
    sim: InputSet
    data: InputSet
    data_file: InputFile
    folder: Path
    monitor: Monitor

    def match(
        self, tensorboard: bool, known: ElectronicsResponse | None = None
    ) -> tuple[nn.Module, dict[str, Any], Recipe]:
        """Match a response, from a known one or that of `init` if there is one.

        Returns
        -------
        tuple
            It, the content of ``run.json``, and its recipe.
        """
        started, clock = datetime.now(UTC), time.perf_counter()
        sides = Sides(
            self.sim.prepared.pulses, self.data.prepared.pulses, self.data_file, self.data
        )
        if self.init is not None:
            known = known_response(self.init, self.data.dt_ns)
        with (
            _losses_shown(self.folder, wanted=tensorboard) as show,
            # most fits need fewer steps than one start may take
            self.monitor.stage("Matching", self.recipe.matching.training.steps) as advance,
        ):

            def listen(step: int, chi_square: float) -> None:
                losses = {"chi_square": chi_square}
                record: Record = {"iteration": step, "rate": 0.0, "losses": losses}
                append_losses(self.folder, [record])
                show([record])
                advance(1)
                self.monitor.state(f"chi-square {chi_square:.4g}")

            model, more, recipe = match(
                sides, self.recipe, self.seed, listen, self.monitor, known
            )
        seconds = time.perf_counter() - clock
        info = self._info(started.isoformat(timespec="seconds"), seconds)
        return model, info | more, recipe

    def train(
        self, resume: bool, tensorboard: bool, stop: Callable[[], bool]
    ) -> tuple[nn.Module, dict[str, Any], Recipe]:
        """Train a CycleGAN, or go on; return it, the content of ``run.json``, its recipe."""
        fingerprint = self._fingerprint()
        require_same_everywhere(self.team, fingerprint)
        run = UnfinishedRun(self.folder, fingerprint, self._environment(), self.monitor.note)
        start = share_state(self.team, run.begin(resume=resume))
        begun = self._network_start()
        left = self.recipe.training.iterations - (start["iteration"] if start else 0)
        with (
            _losses_shown(self.folder, wanted=tensorboard) as show,
            self.monitor.stage("Training", left) as advance,
        ):

            def listen(records: list[Record]) -> None:
                run.log(records)
                show(records)
                advance(len(records))

            model, kept = self._trained(begun, CheckpointHooks(run.save, start, stop), listen)
        run.finish()
        if kept is not None and not kept.kept:
            self.monitor.note(
                "the network does not help held-out pulses and is left out; the chain stays"
            )
        for line in judges_noted(read_losses(self.folder)):
            self.monitor.note(f"warning: {line}")
        resumed = {"resumed_at": run.resumed_at} if run.resumed_at else {}
        info = self._info(run.started, run.seconds) | resumed | begun.told
        if kept is not None:
            info["network"] = asdict(kept)
        return model, info, begun.recipe

    def help_train(self, stop: Callable[[], bool]) -> None:
        """Train with the process that leads, which keeps all."""
        require_same_everywhere(self.team, self._fingerprint())
        start = share_state(self.team, None)
        self._trained(
            self._network_start(), CheckpointHooks(lambda _state: None, start, stop), None
        )

    def _network_start(self) -> NetworkStart:
        sides = Sides(
            self.sim.prepared.pulses, self.data.prepared.pulses, self.data_file, self.data
        )
        return network_start(sides, self.recipe, self.seed, self.init, self.monitor)

    def _trained(
        self, begun: NetworkStart, hooks: CheckpointHooks, listener: Listener | None
    ) -> tuple[nn.Module, Kept | None]:
        """Train; behind a chain, see whether that helps pulses that were held back."""
        sim, data = self.sim.prepared.pulses, self.data.prepared.pulses
        surroundings, recipe, gate = begun.surroundings, begun.recipe, None
        windows = sim.waveforms, data.waveforms
        if surroundings.chain is not None and recipe.cyclegan.training.held_out:
            gate = NetworkGate(*windows, sim.energy_kev, recipe, self.seed)
            windows = sim.waveforms[gate.own], data.waveforms[gate.own_data]
            surroundings = surroundings.of_pulses(gate.own)
        model = train(
            *windows,
            recipe,
            seed=self.seed,
            device=self.device,
            init=begun.fill,
            surroundings=surroundings,
            listener=listener,
            hooks=hooks,
            team=self.team,
        )
        if gate is None or surroundings.chain is None:
            return model, None
        return model, gate.judge(model, surroundings.chain)

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
            "processes": self.team.size,
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
            "processes": self.team.size,
            "threads": torch.get_num_threads(),
            "started": started,
            "seconds": round(seconds, 1),
            "peak_memory_mb": peak_memory_mb(self.device),
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
