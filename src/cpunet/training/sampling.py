"""Truly unpaired batches: each side is drawn on its own, and every pulse is used."""

from __future__ import annotations

import torch
from torch import Tensor


class EpochSampler:
    """Batches of a set of pulses without replacement, reshuffled when too few are left.

    Two samplers with their own generators never meet in the same order twice, so no
    simulated pulse is tied to one measured pulse, and the surplus of the larger
    set is not thrown away.

    Parameters
    ----------
    pulses
        Shape (n, 1, samples), on the device of the training.
    batch_size
        Pulses per batch; smaller sets are drawn with replacement.
    seed
        Seed of the order.
    """

    def __init__(self, pulses: Tensor, batch_size: int, seed: int) -> None:
        self.pulses = pulses
        self.batch_size = batch_size
        self._random = torch.Generator().manual_seed(seed)
        self._order = torch.empty(0, dtype=torch.long)
        self.last_rows = torch.empty(0, dtype=torch.long)
        """Rows of the pulses of the last batch."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return the rows still to be drawn and the state of the random numbers."""
        return {"order": self._order.clone(), "random": self._random.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the state of a sampler of the same pulses."""
        self._order = state["order"]
        self._random.set_state(state["random"])

    def next_batch(self) -> Tensor:
        """Return the next batch, shape (batch, 1, samples)."""
        n = len(self.pulses)
        if n < self.batch_size:
            chosen = torch.randint(n, (self.batch_size,), generator=self._random)
        else:
            if len(self._order) < self.batch_size:
                self._order = torch.randperm(n, generator=self._random)
            chosen = self._order[: self.batch_size]
            self._order = self._order[self.batch_size :]
        self.last_rows = chosen
        return self.pulses[self.last_rows.to(self.pulses.device)]
