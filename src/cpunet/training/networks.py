"""Training of a CycleGAN: resumable."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import torch

from cpunet.electronics.drawn_tails import TraceNoise
from cpunet.electronics.measured import find_tails, measured_noise
from cpunet.errors import CpunetError
from cpunet.progress import stage
from cpunet.pulses.loading import InputSet
from cpunet.recipes.schema import Recipe
from cpunet.training.checkpoints import UnfinishedRun
from cpunet.training.cyclegan import CycleGan, Outside
from cpunet.training.loop import CheckpointHooks, Record, judges_noted, train
from cpunet.training.run import FitInfo, Run, read_losses

if TYPE_CHECKING:
    from cpunet.training.job import TrainingJob

log = logging.getLogger(__name__)

# settings of logs and checkpoints, which do not affect the weights
_CHANGES_NOTHING = {"log_interval", "checkpoint_interval"}


def train_networks(job: TrainingJob) -> Run:
    """Train the networks of a CycleGAN, or resume their training."""
    recipe = job.recipe
    threads = torch.get_num_threads()  # as device and version, it changes the last bits
    environment = {"device": job.device, "threads": threads, "torch": torch.__version__}
    run = UnfinishedRun(job.folder, _fingerprint(job), environment)
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
            hooks=CheckpointHooks(run.save, state),
        )
    run.finish()
    for line in judges_noted(read_losses(job.folder)):
        log.warning(line)
    resumed = {"resumed_at": run.resumed_at} if run.resumed_at else {}
    more: dict[str, Any] = resumed | ({} if fit is None else {"fit": fit})
    return job.run(model, recipe, run.started, run.seconds, **more)


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
        found = find_tails(data, recipe.preparation)
        noise, note = measured_noise(data, recipe.preparation, found.measured)
    except CpunetError as error:
        raise CpunetError(
            f"{data.path}: no baselines to draw noise from ({error}); or train "
            "without it (training.noise=none in `settings`)"
        ) from error
    if note is not None:
        log.warning(note)
    drawn = TraceNoise(noise, found.drawn)
    outside = Outside(drawn, sim.prepared.pulses.energy_kev, recipe.preparation)
    return outside, FitInfo.model_validate({"tails": found.told})


def weights_of(init: Run, recipe: Recipe) -> Callable[[CycleGan], None]:
    """Function that fills networks with the weights of another run.

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
    return partial(_fill, init)


def _fill(run: Run, model: CycleGan) -> None:
    """Fill the networks for which the run has weights, at least REN and IREN."""
    there = {"ren", "iren"} | {name.partition(".")[0] for name in run.weights}
    device = str(next(model.parameters()).device)
    for name, network in model.named_children():
        if name in there:
            was_training = network.training
            run.fill(name, network, device).train(was_training)


def _fingerprint(job: TrainingJob) -> dict[str, Any]:
    """Everything that determines the weights."""
    recipe = job.recipe.model_dump(mode="json")
    del recipe["search"]  # the search space does not affect the weights
    training = recipe["training"]
    recipe["training"] = {k: v for k, v in training.items() if k not in _CHANGES_NOTHING}
    settings = {"recipe": recipe, "peak": job.peak, "seed": job.seed}
    if job.init is not None:
        settings["init"] = job.init.weights_sha256
    return settings | {"simulation": job.sim.fingerprint(), "data": job.data.fingerprint()}
