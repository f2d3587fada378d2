"""Both sides of a game: pulses seen and held out, and the noise of translations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cpunet.electronics.drawn_pile_up import TraceNoise
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import PreparationConfig
from cpunet.training.views import nominal


class Side(NamedTuple):
    """Pulses of a side (n, samples), their energies in keV, and how many of them are seen."""

    pulses: Tensor
    energy_kev: npt.NDArray[np.float64]
    seen: int

    @classmethod
    def of(cls, pulses: Pulses, held_out: float, seed: int, device: str = "cpu") -> Side:
        """Pulses in random order, of which the last part is held out."""
        order = np.random.default_rng(seed).permutation(len(pulses))
        waveforms = torch.from_numpy(pulses.waveforms[order]).to(device)
        kev = pulses.energy_kev[order].astype(float)
        return cls(waveforms, kev, len(order) - round(held_out * len(order)))

    def draw(self, n: int, *, unseen: bool = False) -> Tensor:
        """Rows of a batch, of the pulses that are seen or of the others."""
        first, stop = (self.seen, len(self.pulses)) if unseen else (0, self.seen)
        return torch.randint(first, stop, (n,))


class Sides(NamedTuple):
    """Simulated and measured pulses, and what is done to translations outside the generators.

    Parameters
    ----------
    sim, data
        Both sides.
    preparation
        Their preparation.
    noise
        Noise of the data; None for none.
    scaled
        Whether translations are scaled as the data are; as published, they are not.
    """

    sim: Side
    data: Side
    preparation: PreparationConfig
    noise: TraceNoise | None
    scaled: bool

    def noisy(self, pulses: Tensor, rows: Tensor) -> Tensor:
        """Translations of simulated pulses of these rows, with noise as 1/energy."""
        if self.noise is None:
            return pulses
        # seeded by torch, whose random state is part of a checkpoint
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        drawn = self.noise.draw(self.sim.energy_kev[rows.numpy()], pulses.shape[1], rng)
        return pulses + torch.from_numpy(drawn).to(pulses)

    def prepared(self, pulses: Tensor) -> Tensor:
        """Windows of translations, scaled as the data are."""
        return nominal(pulses, self.preparation) if self.scaled else pulses

    def tolerance(self, windows: Tensor) -> Tensor:
        """RMS of the noise of measured windows, which generators do not make, (n, 1)."""
        rms = windows[:, : self.preparation.baseline_samples].std(dim=1, keepdim=True)
        return rms * (self.noise is not None)
