"""The four networks of CPU-Net and one step of their training (paper, section 3.4)."""

from __future__ import annotations

from itertools import chain
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR

from cpunet.networks.conv_discriminator import ConvDiscriminator
from cpunet.networks.gru_discriminator import GruDiscriminator
from cpunet.networks.kept_noise import KeptNoise
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.recipes.network_settings import ConvConfig, GruConfig
from cpunet.recipes.schema import Recipe
from cpunet.recipes.training_settings import TrainingConfig
from cpunet.training.chain_step import ChainStep
from cpunet.training.compared import Compared, Judged
from cpunet.training.generator_pass import generator_pass
from cpunet.training.losses import fake_loss, real_loss, weighted_l1, window_weights
from cpunet.training.outside import Outside, tolerance
from cpunet.training.surroundings import NONE, Surroundings

LOSS_NAMES = (
    "identity_data",
    "identity_sim",
    "cycle_forward",
    "cycle_backward",
    "adversarial_ren",
    "adversarial_iren",
    "discriminator_data",
    "discriminator_sim",
)


Discriminator = GruDiscriminator | ConvDiscriminator


class CycleGan(nn.Module):
    """REN (sim → data), IREN (data → sim) and a discriminator for each side.

    Saved with them for translations, but not trained, are a matched chain and its inverse, or
    the noise that is added outside the generators.
    """

    def __init__(self, recipe: Recipe, surroundings: Surroundings = NONE) -> None:
        super().__init__()
        length, (generator, discriminator, _) = recipe.network_length, recipe.cyclegan
        self.ren = PositionalUNet(generator, length)
        self.iren = PositionalUNet(generator, length)
        self.discriminator_data = _discriminator(discriminator)
        self.discriminator_sim = _discriminator(discriminator)
        if surroundings.chain is not None:
            chain, inverse = surroundings.chain
            self.chain, self.inverse = chain.requires_grad_(False), inverse
        elif surroundings.outside is not None:
            self.noise = KeptNoise(surroundings.outside.noise.dt_ns)
            self.noise.set_noise(surroundings.outside.noise.noise)

    def generator_parameters(self) -> list[nn.Parameter]:
        """Parameters of REN and IREN."""
        return list(chain(self.ren.parameters(), self.iren.parameters()))


def _discriminator(config: GruConfig | ConvConfig) -> Discriminator:
    if isinstance(config, ConvConfig):
        return ConvDiscriminator(config)
    return GruDiscriminator(config)


def load_optimiser(optimiser: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore an optimiser from a file, whose keys are text instead of numbers."""
    by_number = {int(number): value for number, value in state["state"].items()}
    optimiser.load_state_dict(state | {"state": by_number})


class Step:
    """One training iteration: generators always, discriminators at their interval.

    The learning rates of all three optimisers follow the iteration number, even between
    updates of the discriminators.

    Parameters
    ----------
    model, config
        Networks to train, and settings of the training.
    outside
        Noise and preparation of translations before a discriminator sees them; None for none.
    chain
        Passes with a matched chain, if there is one.
    warmup
        Number of iterations in which the learning rates rise from zero, for networks that
        start near their goal: the first steps of Adam are as long as its rate, whatever the
        gradients (Ma and Yarats 2021, arXiv:1910.04209).
    """

    def __init__(
        self,
        model: CycleGan,
        config: TrainingConfig,
        *,
        outside: Outside | None = None,
        chain: ChainStep | None = None,
        warmup: int = 0,
    ) -> None:
        self.model = model
        self.outside, self.chain = outside, chain
        # of the discriminators, if this iteration updates them
        self.accuracy: dict[str, Tensor] = {}
        self.config, self.warmup = config, warmup
        device = next(model.parameters()).device
        self.weights = window_weights(config.losses).to(device)
        self.noise = config.instance_noise
        self.ren, self.iren = (
            generator_pass(network, config.precision, compiled=config.compiled)
            for network in (model.ren, model.iren)
        )

        def optimiser(parameters: list[nn.Parameter], rate: float) -> AdamW:
            return AdamW(
                parameters,
                lr=rate,
                betas=config.betas,
                weight_decay=config.weight_decay,
                fused=True,
            )

        self.generators = optimiser(model.generator_parameters(), config.rate_generators)
        self.discriminators = [
            optimiser(list(network.parameters()), config.rate_discriminators)
            for network in (model.discriminator_data, model.discriminator_sim)
        ]
        self.schedules = [
            LambdaLR(o, self._rising) for o in (self.generators, *self.discriminators)
        ]

    def state_dict(self) -> dict[str, Any]:
        """Return the state of optimisers and schedules; the networks have their own."""
        return {
            "optimisers": [o.state_dict() for o in (self.generators, *self.discriminators)],
            "schedules": [schedule.state_dict() for schedule in self.schedules],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of a step with the same settings."""
        optimisers = (self.generators, *self.discriminators)
        for optimiser, own in zip(optimisers, state["optimisers"], strict=True):
            load_optimiser(optimiser, own)
        for schedule, own in zip(self.schedules, state["schedules"], strict=True):
            schedule.load_state_dict(own)

    def _rate_factor(self, iteration: int) -> float:
        """Constant, then linear to zero at the end (paper, section 3.4.2)."""
        decay = max(1, self.config.iterations - self.config.decay_start)
        return min(1.0, max(0.0, (self.config.iterations - iteration) / decay))

    def _rising(self, iteration: int) -> float:
        """The factor above, after a linear rise in the first iterations."""
        rise = min(1.0, (iteration + 1) / self.warmup) if self.warmup else 1.0
        return rise * self._rate_factor(iteration)

    def __call__(
        self, iteration: int, sim: Tensor, data: Tensor, rows: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Train on one batch of each side, shapes (batch, 1, samples); return the losses.

        With noise outside the generators, `rows` are the indices of the simulated pulses.
        Discriminator losses are included only in iterations that update the discriminators.
        """
        self.noise = self.config.instance_noise * self._rate_factor(iteration)
        losses, *judged = self._update_generators(sim, data, rows)
        self.accuracy = {}
        if iteration % self.config.discriminator_interval == 0:
            names = ("discriminator_data", "discriminator_sim")
            losses |= self._update_discriminators(dict(zip(names, judged, strict=True)))
        for schedule in self.schedules:
            schedule.step()
        return {name: loss.detach() for name, loss in losses.items()}

    def generator_losses(
        self, sim: Tensor, data: Tensor, rows: Tensor | None = None
    ) -> tuple[dict[str, Tensor], Judged, Judged]:
        """Return the six losses of the generators and the pulses for each discriminator."""
        model, weights = self.model, self.weights
        done = self._compared(sim, data, rows)
        judged_data = model.discriminator_data(self._noisy(done.judged_data.fake))
        judged_sim = model.discriminator_sim(self._noisy(done.judged_sim.fake))
        losses = {
            "identity_data": weighted_l1(*done.identity_data, weights),
            "identity_sim": weighted_l1(*done.identity_sim, weights),
            "cycle_forward": weighted_l1(*done.cycle_forward, weights),
            "cycle_backward": weighted_l1(*done.cycle_backward, weights, done.tolerance),
            "adversarial_ren": real_loss(judged_data),
            "adversarial_iren": real_loss(judged_sim),
        }
        return losses, done.judged_data, done.judged_sim

    def _compared(self, sim: Tensor, data: Tensor, rows: Tensor | None) -> Compared:
        """Run the generators, and add noise to translations if it is added outside of them."""
        outside = self.outside
        if self.chain is not None and outside is not None and rows is not None:
            return self.chain(sim, data, rows, outside)
        fake_data, fake_sim = self.ren(sim), self.iren(data)
        same_data, same_sim = self.ren(data), self.iren(sim)
        cycled_sim, cycled_data = self.iren(fake_data), self.ren(fake_sim)
        noise = None
        if outside is not None and rows is not None:
            fake_data = outside.dress_windows(fake_data, rows)
            noise = tolerance(data, outside.preparation)
        return Compared(
            (same_data, data),
            (same_sim, sim),
            (cycled_sim, sim),
            (cycled_data, data),
            Judged(data, fake_data),
            Judged(sim, fake_sim),
            noise,
        )

    def total(self, losses: dict[str, Tensor]) -> Tensor:
        """Weighted sum of the generators' six losses."""
        c = self.config.losses
        return (
            c.identity_weight * (losses["identity_data"] + losses["identity_sim"])
            + c.cycle_weight * (losses["cycle_forward"] + losses["cycle_backward"])
            + c.adversarial_weight * (losses["adversarial_ren"] + losses["adversarial_iren"])
        )

    def _update_generators(
        self, sim: Tensor, data: Tensor, rows: Tensor | None
    ) -> tuple[dict[str, Tensor], Judged, Judged]:
        model = self.model
        discriminators = (model.discriminator_data, model.discriminator_sim)
        for network in discriminators:  # they are fixed here
            network.requires_grad_(False)
            network.fix_statistics()
        losses, judged_data, judged_sim = self.generator_losses(sim, data, rows)
        self.generators.zero_grad(set_to_none=True)
        self.total(losses).backward()  # type: ignore[no-untyped-call]
        clip_grad_norm_(model.generator_parameters(), self.config.max_grad_norm)
        self.generators.step()
        for network in discriminators:
            network.requires_grad_(True).train()
        return losses, judged_data, judged_sim

    def _noisy(self, pulses: Tensor) -> Tensor:
        """Add the instance noise of this iteration, if any."""
        if not self.noise:
            return pulses
        return pulses + self.noise * torch.randn_like(pulses)

    def _discriminator_loss(
        self, network: Discriminator, real: Tensor, fake: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the adversarial loss, the gradient penalty, and the accuracy."""
        weight = self.config.losses.gradient_penalty
        # in one batch: the batch norm must see both kinds together
        pulses = self._noisy(torch.cat([real, fake])).requires_grad_(weight > 0)
        # cuDNN's GRU has no second derivative
        with torch.backends.cudnn.flags(enabled=weight == 0):
            found = network(pulses)
        loss = real_loss(found[: len(real)]) + fake_loss(found[len(real) :])
        right = torch.cat([found[: len(real)] > 0, found[len(real) :] < 0])
        accuracy = right.float().mean()
        if not weight:
            return loss, torch.zeros_like(loss), accuracy
        (slope,) = torch.autograd.grad(found.sum(), pulses, create_graph=True)
        return loss, weight * slope.square().sum(dim=(1, 2)).mean(), accuracy

    def _update_discriminators(self, judged: dict[str, Judged]) -> dict[str, Tensor]:
        losses = {}
        for (name, pulses), optimiser in zip(judged.items(), self.discriminators, strict=True):
            network = getattr(self.model, name)
            loss, penalty, accuracy = self._discriminator_loss(
                network, pulses.real.detach(), pulses.fake.detach()
            )
            optimiser.zero_grad(set_to_none=True)
            (loss + penalty).backward()  # type: ignore[no-untyped-call]
            clip_grad_norm_(network.parameters(), self.config.max_grad_norm)
            optimiser.step()
            losses[name] = loss
            self.accuracy[name.removeprefix("discriminator_")] = accuracy
        return losses
