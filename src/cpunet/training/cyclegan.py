"""CPU-Net's training, one step of it (paper, section 3.4): networks, losses, optimisers.

Two generators and two discriminators on unpaired batches of both sides::

    sim  ── REN ──▶ fake data ── IREN ──▶ cycled sim       data ── IREN ──▶ same data, …
                        │
             discriminator of data: real or translated?

What calls this, batch by batch, is `cpunet.training.loop`.  All pulses in this module have
the shape (batch, 1, samples).

A generator makes a pulse without noise.  Before a discriminator or a score sees it, noise drawn
from the data's own baselines is added, and the noisy record is prepared like a measured trace,
so that noise affects alignment, baseline and scale like those of the data.  The position of
the window is found without gradients; baseline and scale are differentiable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.nn.utils import clip_grad_norm_
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR

from cpunet.electronics.drawn_pile_up import TraceNoise
from cpunet.electronics.finishing import padding
from cpunet.networks.generators import KeptNoise
from cpunet.networks.positional_unet import GruDiscriminator, PositionalUNet
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import LossConfig, PreparationConfig, Recipe, TrainingConfig

MIN_SCALE = 1e-3
TOLERATED = 3.0  # deviation of a cycle that is ignored, in RMS of the pulse's own baseline


@dataclass(frozen=True, eq=False)
class Outside:
    """Noise and preparation for the translations of a set of simulated pulses.

    Parameters
    ----------
    noise
        Noise of the data's baselines.
    energy_kev
        Energies of the simulated pulses, shape (n,); noise scales as 1/energy.
    preparation
        Preparation of the data.
    """

    noise: TraceNoise
    energy_kev: npt.NDArray[np.float64]
    preparation: PreparationConfig

    def noisy_windows(self, windows: Tensor, rows: Tensor) -> Tensor:
        """Add noise to windows as a network makes them, and prepare them like the data.

        Parameters
        ----------
        windows
            Noise-free windows of prepared height, shape (batch, 1, samples).
        rows
            Indices of the simulated pulses.
        """
        records = in_room(windows[:, 0], self.preparation)
        # seeded by torch, whose random state is part of a checkpoint
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        energies = self.energy_kev[rows.cpu().numpy()]
        drawn = self.noise.draw(energies, records.shape[1], rng)
        noisy = records + torch.from_numpy(drawn).to(records)
        return as_measured(noisy, self.preparation, self.noise.dt_ns)


def in_room(windows: Tensor, config: PreparationConfig) -> Tensor:
    """Extend windows as `cpunet.electronics.finishing.with_room` does, with gradients.

    Noise makes some windows begin later.  The samples that set the scale of a whole pulse then
    lie in the extension, so level and slope of the decay must have their gradients.
    """
    last = windows[:, -config.decay_fit_samples :].double()
    usable = (last > 0).all(dim=1, keepdim=True)  # else the slope is 0
    lever = torch.arange(config.decay_fit_samples).to(last)
    lever = lever - lever.mean()
    slope = torch.where(usable, last, 1).log() @ (lever / lever.square().sum())
    # the mean of the last samples is the level at their centre
    before, after_samples = padding(config.sampled_ns)
    since = torch.arange(after_samples).to(last) + 0.5 * (config.tail_samples + 1)
    level = last[:, -config.tail_samples :].mean(dim=1, keepdim=True)
    after = level * (slope[:, None] * since).exp()
    return torch.cat(
        [windows.new_zeros(len(windows), before), windows, after.to(windows)], dim=1
    )


def as_measured(records: Tensor, config: PreparationConfig, dt_ns: float) -> Tensor:
    """Prepare records like measured traces, with gradients for all but the alignment.

    A record that cannot be prepared, as may happen early in a training, is cut at the nominal
    position.
    """
    raw = Pulses.of(records.detach().cpu().numpy(), dt_ns=dt_ns)
    prepared = prepare(
        raw, config.model_copy(update={"saturation_run": raw.length}), "measured"
    )
    align = np.full(len(records), padding(dt_ns)[0] + config.samples_before)
    align[prepared.index] = prepared.align_sample
    start = torch.from_numpy(align - config.samples_before).to(records.device)
    index = start[:, None] + torch.arange(config.length, device=records.device)
    windows = records.gather(1, index.clamp(0, records.shape[1] - 1))
    windows = windows - windows[:, : config.baseline_samples].mean(dim=1, keepdim=True)
    level = windows[:, -config.tail_samples :].mean(dim=1, keepdim=True)
    scale = (level / config.tail_level).clamp_min(MIN_SCALE)
    return (windows / scale)[:, None]


def tolerance(data: Tensor, config: PreparationConfig) -> Tensor:
    """Tolerance for the noise of each measured pulse, shape (batch, 1, 1).

    A cycle that starts from a measured pulse cannot reproduce its noise, which generators do
    not make.  Deviations within this tolerance are therefore ignored.
    """
    return TOLERATED * data[..., : config.baseline_samples].std(dim=-1, keepdim=True)


class CycleGan(nn.Module):
    """REN (sim → data), IREN (data → sim) and a discriminator for each side.

    Noise that is added outside the generators is saved with them, for translations.
    """

    def __init__(self, recipe: Recipe, outside: Outside | None = None) -> None:
        super().__init__()
        config, self.length = recipe.cyclegan, recipe.preparation.length
        self.ren = PositionalUNet(config.generator, self.length)
        self.iren = PositionalUNet(config.generator, self.length)
        self.discriminator_data = GruDiscriminator(config.discriminator)
        self.discriminator_sim = GruDiscriminator(config.discriminator)
        self.noise: KeptNoise | None = None
        if outside is not None:
            self.noise = KeptNoise(outside.noise.dt_ns)
            self.noise.set_noise(outside.noise.noise)

    def generator_parameters(self) -> list[nn.Parameter]:
        """Parameters of REN and IREN."""
        return [*self.ren.parameters(), *self.iren.parameters()]

    def discriminators(self) -> dict[str, GruDiscriminator]:
        """The discriminators by side."""
        return {"data": self.discriminator_data, "sim": self.discriminator_sim}


def window_weights(config: LossConfig, length: int) -> Tensor:
    """Weight of each sample in the L1 losses, shape (samples,).

    Baseline, rising edge and tail each count as their weight times the *mean*
    absolute difference in their window, whatever its length.
    """
    begin, end = config.edges
    windows = (
        (begin, config.baseline_weight),
        (end - begin, config.rising_edge_weight),
        (length - end, config.tail_weight),
    )
    return torch.cat([torch.full((length,), weight / length) for length, weight in windows])


def weighted_l1(
    pulses: Tensor, others: Tensor, weights: Tensor, ignored: Tensor | None = None
) -> Tensor:
    r"""Weighted absolute difference, per pulse, then averaged over the batch.

    .. math:: L_1 = \Big\langle \sum_k w_k \max(|x_k - y_k| - g, 0) \Big\rangle

    `weights` :math:`w` has shape (samples,); `ignored` is a part :math:`g` of each difference
    that does not count, shape (batch, 1, 1).

    Examples
    --------
    >>> pulse = torch.tensor([[[0.0, 1.0]]])
    >>> float(weighted_l1(pulse, 0 * pulse, torch.tensor([2.0, 0.5])))
    0.5
    """
    apart = (pulses - others).abs()  # (batch, 1, samples)
    if ignored is not None:
        apart = (apart - ignored).clamp_min(0)
    return (apart * weights).sum(dim=-1).mean()


def real_loss(logits: Tensor) -> Tensor:
    r"""Binary cross-entropy of calling these pulses real.

    .. math:: -\langle \ln \sigma(l) \rangle, \qquad \sigma(l) = 1 / (1 + e^{-l})

    Examples
    --------
    >>> round(float(real_loss(torch.zeros(3))), 4)  # undecided: ln 2
    0.6931
    """
    return binary_cross_entropy_with_logits(logits, torch.ones_like(logits))


def fake_loss(logits: Tensor) -> Tensor:
    r"""Binary cross-entropy of calling these pulses translated.

    .. math:: -\langle \ln (1 - \sigma(l)) \rangle
    """
    return binary_cross_entropy_with_logits(logits, torch.zeros_like(logits))


class Step:
    """One training iteration: generators always, discriminators at their interval.

    Parameters
    ----------
    model, config
        Networks to train, and settings of the training.
    outside
        Noise and preparation of translations before a discriminator sees them; None for none.
    warmup
        Iterations in which the learning rates rise from zero, for networks that start near
        their goal: Adam's first steps are as long as its rate (arXiv:1910.04209).
    """

    def __init__(
        self,
        model: CycleGan,
        config: TrainingConfig,
        *,
        outside: Outside | None = None,
        warmup: int = 0,
    ) -> None:
        self.model, self.config = model, config
        self.outside, self.warmup = outside, warmup
        self.accuracy: dict[str, Tensor] = {}  # of the discriminators, if updated
        weights = window_weights(config.losses, model.length)
        self.weights = weights.to(next(model.parameters()).device)
        self.ren, self.iren = (_pass(network, config) for network in (model.ren, model.iren))

        def adamw(parameters: list[nn.Parameter], rate: float) -> AdamW:
            decay = config.weight_decay
            return AdamW(parameters, rate, config.betas, weight_decay=decay, fused=True)

        rate = config.rate_discriminators
        self.generators = adamw(model.generator_parameters(), config.rate_generators)
        self.discriminators = {
            side: adamw(list(network.parameters()), rate)
            for side, network in model.discriminators().items()
        }
        self.optimisers = [self.generators, *self.discriminators.values()]
        # of the discriminators, too, the rates follow the iterations, not their own updates
        self.schedules = [LambdaLR(o, self._rate_factor) for o in self.optimisers]

    def __call__(
        self, iteration: int, sim: Tensor, data: Tensor, rows: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Train on one batch of each side; return the losses, a discriminator's if updated.

        With noise outside the generators, `rows` are the indices of the simulated pulses.
        """
        model, limit = self.model, self.config.max_grad_norm
        for network in model.discriminators().values():  # they are fixed here
            network.requires_grad_(False)
            network.norm.eval()  # not the GRU: cuDNN's has no backward pass in evaluation
        losses, fakes = self.generator_losses(sim, data, rows)
        self.generators.zero_grad(set_to_none=True)
        self.total(losses).backward()  # type: ignore[no-untyped-call]
        clip_grad_norm_(model.generator_parameters(), limit)
        self.generators.step()
        for network in model.discriminators().values():
            network.requires_grad_(True).train()
        self.accuracy = {}
        if iteration % self.config.discriminator_interval == 0:
            for side, real in (("data", data), ("sim", sim)):
                losses[f"discriminator_{side}"] = self._update(side, real, fakes[side].detach())
        for schedule in self.schedules:
            schedule.step()
        return {name: loss.detach() for name, loss in losses.items()}

    def generator_losses(
        self, sim: Tensor, data: Tensor, rows: Tensor | None = None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        r"""The six losses of the generators, and translated pulses by side.

        With REN :math:`F`, IREN :math:`G`, simulated pulses :math:`x` and measured ones
        :math:`y` (paper, section 3.4.1): identities :math:`|F(y) - y|` and
        :math:`|G(x) - x|`, cycles :math:`|G(F(x)) - x|` and :math:`|F(G(y)) - y|`, and the
        adversarial losses (`real_loss`) of :math:`F(x)` and :math:`G(y)`.
        """
        ren, iren, weights = self.ren, self.iren, self.weights
        fake_data, fake_sim = ren(sim), iren(data)
        same_data, same_sim = ren(data), iren(sim)
        cycled_sim, cycled_data = iren(fake_data), ren(fake_sim)
        ignored = None
        if self.outside is not None and rows is not None:
            # generators make no noise: discriminators see it, and cycles of data lack it
            fake_data = self.outside.noisy_windows(fake_data, rows)
            ignored = tolerance(data, self.outside.preparation)
        judged_data = self.model.discriminator_data(fake_data)  # (batch,)
        judged_sim = self.model.discriminator_sim(fake_sim)
        losses = {
            "identity_data": weighted_l1(same_data, data, weights),
            "identity_sim": weighted_l1(same_sim, sim, weights),
            "cycle_forward": weighted_l1(cycled_sim, sim, weights),
            "cycle_backward": weighted_l1(cycled_data, data, weights, ignored),
            "adversarial_ren": real_loss(judged_data),
            "adversarial_iren": real_loss(judged_sim),
        }
        return losses, {"data": fake_data, "sim": fake_sim}

    def total(self, losses: dict[str, Tensor]) -> Tensor:
        """Weighted sum of the generators' six losses."""
        c = self.config.losses
        return (
            c.identity_weight * (losses["identity_data"] + losses["identity_sim"])
            + c.cycle_weight * (losses["cycle_forward"] + losses["cycle_backward"])
            + c.adversarial_weight * (losses["adversarial_ren"] + losses["adversarial_iren"])
        )

    def _update(self, side: str, real: Tensor, fake: Tensor) -> Tensor:
        """Update the discriminator of a side; return its loss."""
        network, optimiser = self.model.discriminators()[side], self.discriminators[side]
        # in one batch: the batch norm must see both kinds together
        logits = network(torch.cat([real, fake]))  # (2 batch,)
        of_real, of_fake = logits[: len(real)], logits[len(real) :]
        loss = real_loss(of_real) + fake_loss(of_fake)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        clip_grad_norm_(network.parameters(), self.config.max_grad_norm)
        optimiser.step()
        self.accuracy[side] = torch.cat([of_real > 0, of_fake < 0]).float().mean()
        return loss

    def _rate_factor(self, iteration: int) -> float:
        """A linear rise after a start, then constant, then linear to zero (section 3.4.2)."""
        rise = min(1.0, (iteration + 1) / self.warmup) if self.warmup else 1.0
        config, left = self.config, max(0, self.config.iterations - iteration)
        return rise * min(1.0, left / max(1, config.iterations - config.decay_start))


def _pass(network: nn.Module, config: TrainingConfig) -> Callable[[Tensor], Tensor]:
    """A generator's forward pass; weights, losses and discriminators stay in float32."""
    run: Callable[[Tensor], Tensor] = torch.compile(network) if config.compiled else network
    if config.precision == "float32":
        return run

    def in_bf16(pulses: Tensor) -> Tensor:
        with torch.autocast(pulses.device.type, torch.bfloat16):
            return run(pulses).to(pulses.dtype)

    return in_bf16
