"""The optimisers of a game, whose rates rise and fall together."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn.utils import clip_grad_norm_

from cpunet.recipes.schema import TrainingConfig


class Optimisers:
    """An optimiser for U-Nets, linear parts and each critic.

    Parameters
    ----------
    generators, critics
        Networks by name; what is linear in a generator is named so.
    config
        Rates, and how they change.
    """

    def __init__(
        self, generators: nn.ModuleDict, critics: nn.ModuleDict, config: TrainingConfig
    ) -> None:
        named, self.config = [*generators.named_parameters()], config
        parts = {
            "unet": ([p for name, p in named if ".unet." in name], config.rate_generators),
            "linear": ([p for name, p in named if ".linear." in name], config.rate_linear),
        }
        self.critics = [*critics]
        for name, network in critics.items():
            parts[name] = [*network.parameters()], config.rate_discriminators
        self.rates = {name: rate for name, (own, rate) in parts.items() if own}
        how: Any = {"betas": config.betas, "weight_decay": config.weight_decay}
        self.of = {
            name: torch.optim.AdamW(parts[name][0], rate, **how)
            for name, rate in self.rates.items()
        }

    def set_rates(self, done: int) -> float:
        """Rates after so many iterations; that of the U-Nets."""
        c, rates = self.config, dict[str, float]()
        rise = (done + 1) / max(1, c.warmup)
        left = min(1.0, (c.iterations - done) / max(1, c.iterations - c.decay_start))
        for name, rate in self.rates.items():
            fall = max(left**c.decay_power, c.least_rate if name in self.critics else 0.0)
            rates[name] = rate * min(1.0, rise, fall)
            self.of[name].param_groups[0]["lr"] = rates[name]
        return rates["unet"]

    def follow(self, loss: Any, *names: str) -> None:
        """Move parts down the slope of a loss."""
        own = [self.of[name] for name in names if name in self.of]
        for optimiser in own:
            optimiser.zero_grad(set_to_none=True)
        loss.backward()
        for optimiser in own:
            clip_grad_norm_(optimiser.param_groups[0]["params"], self.config.max_grad_norm)
            optimiser.step()

    def state_dict(self) -> dict[str, Any]:
        """All that changes."""
        return {name: optimiser.state_dict() for name, optimiser in self.of.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state."""
        for name, optimiser in self.of.items():
            optimiser.load_state_dict(state[name])
