"""Training of a CycleGAN: resumable."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import torch
from torch import nn

from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.training.network_start import NetworkStart, network_start
from cpunet.jobs.training.training_job import Trained, TrainingJob, TrainOptions
from cpunet.recipes.schema import Recipe
from cpunet.training.held_out import Kept
from cpunet.training.judges import judges_noted
from cpunet.training.loop import CheckpointHooks, Listener, Record, State, train
from cpunet.training.network_gate import NetworkGate
from cpunet.training.pairs import number_of_pairs
from cpunet.training.run_folder import read_losses, weights_sha256
from cpunet.training.unfinished import UnfinishedRun, unfinished_folder

# settings of logs and checkpoints, which do not affect the weights
_CHANGES_NOTHING = {"log_interval", "checkpoint_interval"}


class CycleGanTrainer:
    """Trains a CycleGAN; see `cpunet.jobs.training.trainers.Trainer`."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.config = recipe.cyclegan.training
        self.steps = self.config.iterations

    def workplace(
        self,
        out: Path,
        read: Sequence[Path | str | None],
        options: TrainOptions,
    ) -> AbstractContextManager[Path]:
        """Context of ``OUT.unfinished``, which becomes `out` when the training is complete."""
        resume, force = options.resume, options.force
        return unfinished_folder(out, *read, resume=resume, force=force)

    def train(self, job: TrainingJob) -> Trained:
        """Train or resume."""
        run = UnfinishedRun(job.folder, _fingerprint(job), _environment(job), job.monitor.note)
        state = run.begin(resume=job.options.resume)
        how = job.options
        start = network_start(job.sides, self.recipe, how.seed, how.init, job.monitor)
        with _Stages(job.monitor, start, self.steps, state) as stages:

            def listen(records: list[Record]) -> None:
                run.log(records)
                stages.trained(len(records))

            hooks = CheckpointHooks(run.save, state, job.stop, stages.paired)
            model, kept = self._trained(job, start, hooks, listen)
        run.finish()
        if kept is not None and not kept.kept:
            job.monitor.note(
                "the network does not help held-out pulses and is left out; the chain stays"
            )
        for line in judges_noted(read_losses(job.folder)):
            job.monitor.note(f"warning: {line}")
        resumed = {"resumed_at": run.resumed_at} if run.resumed_at else {}
        info = job.info(run.started, run.seconds) | resumed | start.told
        if kept is not None:
            info["network"] = asdict(kept)
        return Trained(model, info, start.recipe)

    def _trained(
        self,
        job: TrainingJob,
        start: NetworkStart,
        hooks: CheckpointHooks,
        listener: Listener,
    ) -> tuple[nn.Module, Kept | None]:
        """Train; with a chain, also check whether the network improves held-out pulses."""
        sim, data = job.sim.prepared.pulses, job.data.prepared.pulses
        surroundings, recipe, gate = start.surroundings, start.recipe, None
        windows = sim.waveforms, data.waveforms
        if surroundings.chain is not None and recipe.cyclegan.training.held_out:
            gate = NetworkGate(*windows, sim.energy_kev, recipe, job.options.seed)
            windows = sim.waveforms[gate.own], data.waveforms[gate.own_data]
            surroundings = surroundings.of_pulses(gate.own)
        model = train(
            *windows,
            recipe,
            seed=job.options.seed,
            device=job.options.device,
            init=start.fill,
            surroundings=surroundings,
            listener=listener,
            hooks=hooks,
        )
        if gate is None or surroundings.chain is None:
            return model, None
        return model, gate.judge(model, surroundings.chain)


class _Stages(ExitStack):
    """Show the stages of a training one after the other: iterations on pairs, and its own."""

    def __init__(
        self, monitor: Monitor, start: NetworkStart, steps: int, state: State | None
    ) -> None:
        super().__init__()
        self._monitor = monitor
        self._steps = steps - (state["iteration"] if state else 0)
        self._pairs = number_of_pairs(start.recipe, start.surroundings)
        if state is not None:
            done = state["pairs"]["iteration"] if "pairs" in state else self._pairs
            self._pairs -= done

    def __enter__(self) -> Self:
        super().__enter__()
        self._begin()
        return self

    def _begin(self) -> None:
        of_pairs = ("Learning pairs", self._pairs)
        stage = of_pairs if self._pairs else ("Training", self._steps)
        self._advance = self.enter_context(self._monitor.stage(*stage))

    def paired(self, steps: int) -> None:
        """Count iterations on pairs; after the last one the next stage begins."""
        self._advance(steps)
        self._pairs -= steps
        if not self._pairs:
            self.close()
            self._begin()

    def trained(self, steps: int) -> None:
        """Count iterations of the training."""
        self._advance(steps)


def _fingerprint(job: TrainingJob) -> dict[str, Any]:
    """Everything that determines the weights."""
    recipe = job.recipe.model_dump(mode="json")
    del recipe["search"]  # the search space does not affect the weights
    training = recipe["training"]
    recipe["training"] = {k: v for k, v in training.items() if k not in _CHANGES_NOTHING}
    settings = {"recipe": recipe, "peak": job.options.peak, "seed": job.options.seed}
    if job.options.init is not None:
        settings["init"] = weights_sha256(job.options.init)
    return settings | {"simulation": job.sim.fingerprint(), "data": job.data.fingerprint()}


def _environment(job: TrainingJob) -> dict[str, Any]:
    """Environment that affects the last bits of the weights."""
    return {
        "device": job.options.device,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
