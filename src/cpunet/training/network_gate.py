"""Keep a CycleGAN's network after a chain only if it improves pulses it has not seen."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import Recipe
from cpunet.training.chain_step import ChainStep
from cpunet.training.cyclegan import CycleGan
from cpunet.training.held_out import Aim, Kept, judge, split_rows
from cpunet.training.outside import of_height
from cpunet.training.surroundings import MatchedChain

LEAST_FALL = 0.02  # minimum relative decrease of chi-square
HELD_OUT = 1_000_003  # keeps the choice of pulses apart from other uses of a seed


class NetworkGate:
    """Hold back pulses of both sides, and test REN with them.

    Parameters
    ----------
    sim, data
        Prepared windows, shapes (n, samples) and (n', samples).
    energy_kev
        Energies of the simulated pulses.
    recipe
        Recipe with a chain.
    seed
        Seed of the pulses held back and of the noise.
    """

    def __init__(
        self,
        sim: FloatArray,
        data: FloatArray,
        energy_kev: npt.NDArray[np.float64],
        recipe: Recipe,
        seed: int,
    ) -> None:
        self.sim, self.data, self.energy_kev, self.recipe = sim, data, energy_kev, recipe
        self._rng = np.random.default_rng([seed, HELD_OUT])
        share = recipe.cyclegan.training.held_out
        self.own, self._held = split_rows(len(sim), share, self._rng)
        self.own_data, self._held_data = split_rows(len(data), share, self._rng)

    def judge(self, model: CycleGan, chain: MatchedChain) -> Kept:
        """Make the correction of REN's network exactly zero unless it improves pulses."""
        aim = Aim.at(self.data, self.recipe.of_chain)
        held_out = aim.at_others(self.data[self._held_data])
        ren, level = model.cpu().ren, self.recipe.preparation.tail_level  # moves the chain, too
        correction = ChainStep(*chain, ren, model.iren, self.recipe).correction.eval()
        with torch.no_grad():
            pulses = torch.from_numpy(self.sim[self._held])
            records = of_height(chain.generator.response(pulses), level)
        energies = self.energy_kev[self._held]
        drawn = chain.generator.trace_noise.draw(energies, records.shape[1], self._rng)
        noise = torch.from_numpy(drawn).to(records)
        found = judge(correction, held_out, records, noise, LEAST_FALL, self._rng)
        if not found.kept:
            nn.init.zeros_(ren.outlet.weight)
            assert ren.outlet.bias is not None
            nn.init.zeros_(ren.outlet.bias)
        return found
