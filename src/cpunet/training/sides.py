"""Both sides of a game: pulses seen and held out, noise of translations, critics judged."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cpunet.electronics.drawn_pile_up import TraceNoise
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import PreparationConfig
from cpunet.training.views import nominal

log = logging.getLogger(__name__)

RECENT = 20  # judgements that are averaged
# Part of unseen pairs on which a critic is right that has won; part of a training before which
# none is at chance, and none has won.
WON, EARLY, HALF = 0.97, 0.25, 0.5


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


class Judge:
    """How often critics are right on pulses that they have not seen, and when a game is over.

    A critic that is right by chance on unseen pulses knows its own by heart, and has nothing to
    teach; a critic that is nearly always right teaches nothing either, for its slope is flat.

    Parameters
    ----------
    sides
        Names of the critics.
    unseen
        Number of pulses of a side that are held out.
    """

    def __init__(self, sides: Sequence[str], unseen: int) -> None:
        self.unseen, self.over = unseen, dict[str, str]()
        self.recent: dict[str, list[float]] = {side: [] for side in sides}

    def note(self, side: str, right: float, done: float) -> None:
        """Note how often a critic is right, when a part of the training is done."""
        recent = self.recent[side] = [*self.recent[side], right][-RECENT:]
        mean = float(np.mean(recent))
        if len(recent) < RECENT or side in self.over:
            return
        text = f"right on {100 * mean:.0f} % of pulses that it has not seen"
        if mean > WON and done > HALF:
            self.over[side], end = "won", "its game ends here, and the average before counts"
            log.warning(f"the critic of {side} has won: it is {text}; {end}")
        elif mean < 0.5 + 0.5 * self.unseen**-0.5 and done > EARLY:
            self.over[side] = "chance"
            log.info(f"the critic of {side} is {text}, as by guessing; its game ends here")

    def winning(self, side: str) -> bool:
        """Whether a critic has been right nearly always lately."""
        return float(np.mean(self.recent[side])) > WON

    @property
    def ended(self) -> bool:
        """Whether nothing is left to be played for."""
        return self.over.get("data") == "won" or len(self.over) == len(self.recent)
