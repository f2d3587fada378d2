"""Networks of a recipe, trained on the pulses of a job, used as far as held-out pulses gain."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.optim.swa_utils import update_bn

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import finish
from cpunet.electronics.measured import trace_noise
from cpunet.errors import CpunetError
from cpunet.networks.generators import KeptNoise, LinearInverse, ResponseGenerator
from cpunet.networks.linear_parts import (
    LearnedInverse,
    LearnedResponse,
    SolvedInverse,
    SolvedResponse,
)
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.progress import stage
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import pulse_parameters
from cpunet.pulses.two_sample import TwoSample, classifier_auc
from cpunet.recipes.schema import Recipe, TrainingConfig
from cpunet.training.adversarial import Game, Generator, Residual, train
from cpunet.training.run import Record, Run
from cpunet.training.unfinished import UnfinishedRun
from cpunet.training.verdict import FitInfo
from cpunet.training.views import Side, Sides

if TYPE_CHECKING:
    from cpunet.training.job import TrainingJob

log = logging.getLogger(__name__)

ENOUGH, MANY = 600, 4000  # pulses of a side that a critic needs, and that a large critic needs
SMALL = {"convolutional": {"channels": 8, "hidden": 32, "components": 32}}
SCALES = 0.0, 0.5, 1.0  # of what a U-Net adds
SURE, MOST = 2.0, 2000  # standard errors of a gain, and held-out pulses that decide
LEAST = 0.02  # part of the mean square of a cycle that a gain must be
# settings of logs and checkpoints, which do not affect the weights
_LOGS: Any = {"log_interval", "checkpoint_interval"}


def generators(
    recipe: Recipe, decay: float = 0.0, linear: Mapping[str, nn.Module] | None = None
) -> dict[str, Generator]:
    """New generators.

    Parameters
    ----------
    recipe
        Recipe of networks; as published, generators have no linear part.
    decay
        Of the data per sample, where the learned linear part begins.
    linear
        Solved linear parts; None for those that are learned.
    """
    config, preparation = recipe.cyclegan.generator, recipe.preparation
    if config.linear == "none":
        length = preparation.length
        return {part: Generator(PositionalUNet(config, length)) for part in ("ren", "iren")}
    if linear is None:
        response = LearnedResponse(preparation, decay)
        linear = {"ren": response, "iren": LearnedInverse(response)}
    dt_ns = preparation.sampled_ns
    return {part: Generator(Residual(config, dt_ns), of) for part, of in linear.items()}


def train_networks(job: TrainingJob) -> Run:
    """Train the generators of a CycleGAN, or resume their training."""
    recipe, own, noise, info = job.recipe, job.recipe.preparation, None, None
    if recipe.cyclegan.training.noise == "baselines":
        try:
            noise, tails = trace_noise(job.data, own)
        except CpunetError as error:
            raise CpunetError(
                f"{job.data.path}: no baselines to draw noise from ({error}); or train "
                "without it (training.noise=none in `settings`)"
            ) from error
        info = FitInfo(tails=tails)
    late = job.data.prepared.pulses.waveforms[:, -own.decay_fit_samples :].mean(axis=0)
    decay = -np.polyfit(np.arange(len(late)), np.log(np.maximum(late, 1e-3)), 1)[0]

    game, run = _played(job, recipe, partial(generators, recipe, float(decay)), noise)
    parts: dict[str, Any] = {}
    for part, side in (("ren", game.sides.sim), ("iren", game.sides.data)):
        network = game.average[part]
        if network.linear is None:
            settle(network, side, game.config)
        parts[part] = network.unet if network.linear is None else network
    parts |= {f"discriminator_{side}": critic for side, critic in game.critics.items()}
    if noise is not None:
        parts["noise"] = KeptNoise(noise.dt_ns)
        parts["noise"].set_noise(noise)
    more: dict[str, Any] = {"resumed_at": run.resumed_at, "fit": info}
    more = {name: value for name, value in more.items() if value}
    return job.run(parts, recipe, run.started, run.clock, log=run.records, **more)


def fill_generator(run: Run, part: str, network: Generator, device: str = "cpu") -> Generator:
    """Fill a generator, with or without a linear part, with the weights of a run."""
    run.fill(part, network.unet if network.linear is None else network, device)
    return network


def _played(
    job: TrainingJob,
    recipe: Recipe,
    make: Callable[[], Mapping[str, Generator]],
    noise: BaselineNoise | None,
) -> tuple[Game, UnfinishedRun]:
    """Play the game of a recipe, or the rest of it, with all that is needed to resume it."""
    settings = recipe.cyclegan
    exclude: Any = {"search": True, "training": _LOGS, "residual": {"training": _LOGS}}
    run = UnfinishedRun(
        job.checkpoints,
        {
            "recipe": recipe.model_dump(mode="json", exclude=exclude),
            "peak": job.peak,
            "seed": job.seed,
            "simulation": job.sim.fingerprint(),
            "data": job.data.fingerprint(),
        },
        resume=job.resume,
    )
    pair = (side.prepared.pulses for side in (job.sim, job.data))
    held_out = settings.training.held_out
    sim, data = (Side.of(pulses, held_out, job.seed, job.device) for pulses in pair)
    if min(sim.seen, data.seen) < MANY:  # which a large critic knows by heart
        critic = settings.discriminator
        small = critic.model_copy(update=SMALL.get(critic.name))
        settings = settings.model_copy(update={"discriminator": small})
    sides = Sides(sim, data, recipe.preparation, noise, settings.generator.linear != "none")
    left = settings.training.iterations - (run.state["iteration"] if run.state else 0)
    with stage("Training", left) as bar:

        def listen(records: list[Record]) -> None:
            run.records += records
            bar.update(len(records))

        game = train(
            lambda: Game(**make(), sides=sides, settings=settings),
            job.seed,
            listener=listen,
            save=run.save,
            start=run.state,
        )
    return game, run


def settle(network: nn.Module, side: Side, config: TrainingConfig) -> None:
    """Replace the running statistics of batch norms by averages over the pulses of a side.

    In training a generator sees pulses of both sides (identity and cycle losses).  For a side
    alone, the running averages of both shift the tail slope of a translation by more than its
    spread (Wu and Johnson 2021, arXiv:2105.07576, section 3).  Dropout is off meanwhile, as in
    a translation: it raises the variance at the batch norms behind it, here by up to a sixth
    (Li et al. 2019, CVPR, "variance shift").
    """
    # `update_bn` switches every module to training mode
    layers = [module for module in network.modules() if isinstance(module, nn.Dropout)]
    fractions = [layer.p for layer in layers]
    for layer in layers:
        layer.p = 0.0
    with torch.random.fork_rng():
        torch.manual_seed(0)
        batches = range(config.statistics_batches)
        update_bn((side.pulses[side.draw(config.batch_size)] for _ in batches), network)
    for layer, fraction in zip(layers, fractions, strict=True):
        layer.p = fraction


def learned_residuals(
    job: TrainingJob, recipe: Recipe, chain: ResponseGenerator, inverse: LinearInverse
) -> tuple[dict[str, Residual], dict[str, str], list[Record]]:
    """Train U-Nets behind a response and its inverse, and keep what held-out pulses gain by.

    Returns
    -------
    tuple
        U-Nets that are kept by part, a line on each that was tried, and the log.
    """
    n = min(len(job.sim.prepared), len(job.data.prepared))
    if n < ENOUGH or chain.response.by_height is not None:
        why = f"{n} pulses of a side, a critic needs {ENOUGH}"
        if n >= ENOUGH:
            why = "they know no energies, by which the electronics act"
        return {}, {"networks": f"left out; {why}"}, []
    response = SolvedResponse(chain.response, recipe.preparation)
    linear = {"ren": response, "iren": SolvedInverse(inverse)}
    noise = replace(chain.noise, tails=chain.tails)
    game, run = _played(job, recipe, partial(generators, recipe, linear=linear), noise)
    parts, gains = dict[str, Residual](), dict[str, str]()
    for name, (scale, line) in (
        ("ren", _ren_scale(game, chain, recipe)),
        ("iren", _iren_scale(game)),
    ):
        gains[f"U-Net of {name.upper()}"] = line
        residual = game.average[name].unet
        if scale and isinstance(residual, Residual):
            with torch.no_grad():
                for values in residual.unet.outlet.parameters():
                    values.mul_(scale)
            parts[f"{name}_residual"] = residual
    return parts, gains, run.records


def applied(network: nn.Module) -> Callable[[Any], npt.NDArray[np.float32]]:
    """A network as a function of arrays."""
    device = next(network.parameters()).device

    def change(pulses: Any) -> npt.NDArray[np.float32]:
        with torch.inference_mode():
            made = network(torch.from_numpy(np.asarray(pulses, np.float32)).to(device))
        return np.asarray(made.cpu().numpy())

    return change


def _scale(best: int, gain: float, error: float, text: str) -> tuple[float, str]:
    """The best of `SCALES`, if it gains, and a line on it."""
    if gain <= 0 or gain < SURE * error:
        return 0.0, f"left out; {text}"
    return SCALES[best], f"used, scaled by {SCALES[best]:g}; {text}"


def _ren_scale(game: Game, chain: ResponseGenerator, recipe: Recipe) -> tuple[float, str]:
    """Scale of REN's U-Net with which a classifier of held-out pulses is least right."""
    sim, data, preparation = game.sides.sim, game.sides.data, recipe.preparation
    charge, real = (side.pulses[side.seen :][:MOST].cpu().numpy() for side in (sim, data))
    residual = game.average["ren"].unet
    assert isinstance(residual, Residual)
    records, results = chain.response(charge), list[TwoSample]()
    change = applied(residual)(records)
    for scale in SCALES:
        windows = finish(
            records + np.float32(scale) * change,
            preparation,
            dt_ns=preparation.sampled_ns,
            noise=game.sides.noise,
            energy_kev=sim.energy_kev[sim.seen :][:MOST],
        ).windows
        windows = windows[np.isfinite(windows).all(axis=1)]
        pair = (Pulses.of(pulses, dt_ns=preparation.sampled_ns) for pulses in (real, windows))
        values = [pulse_parameters(pulses, preparation, recipe.scores) for pulses in pair]
        features = values[0], values[1]
        results.append(classifier_auc(real, windows, seed=0, features=features))
    best = int(np.argmin([result.auc for result in results]))
    text = f"AUC of held-out pulses {results[0].auc:.3f} → {results[-1].auc:.3f}"
    error = results[0].auc_std
    return _scale(best, results[0].auc - results[best].auc, error, f"{text} ± {error:.3f}")


@torch.no_grad()
def _iren_scale(game: Game) -> tuple[float, str]:
    """Scale of IREN's U-Net with which held-out cycles end closest to where they began."""
    sides, pair = game.sides, dict[str, Any](game.average.items())
    ren, iren = pair["ren"], pair["iren"]
    rows = torch.arange(sides.sim.seen, len(sides.sim.pulses))[:MOST]
    with torch.random.fork_rng():
        torch.manual_seed(0)
        noisy = sides.noisy(ren.linear(sides.sim.pulses[rows]), rows)
    back = iren.linear(sides.prepared(noisy))
    error_of_cycle, change = back - sides.sim.pulses[rows], iren.change(back)
    squares = [(error_of_cycle + scale * change).square().mean(dim=1) for scale in SCALES]
    best = int(np.argmin([float(square.mean()) for square in squares]))
    gains = squares[0] - squares[best]
    rms = [float(square.mean().sqrt()) for square in squares]
    text = f"RMS of held-out cycles {rms[0]:.2e} → {rms[-1]:.2e}"
    error = max(float(gains.std()) / len(rows) ** 0.5, LEAST * float(squares[0].mean()) / SURE)
    return _scale(best, float(gains.mean()), error, text)
