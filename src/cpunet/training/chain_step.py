"""Forward passes of a training step with U-Nets that follow a matched chain.

The chain and its inverse are fixed; the U-Nets correct what these leave.  Cycles keep track of
how far each pulse was shifted, so that it is compared with itself sample by sample.  The
discriminators see both sides aligned at half maximum, where noise does not shift a pulse by
tens of samples.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cpunet.networks.chain_unet import TAIL, InverseUNet, UNetCorrection
from cpunet.networks.hybrid import half_sample
from cpunet.networks.linear_inverse import LinearInverse, stretch
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.networks.response_layer import PADDING_BEFORE
from cpunet.recipes.schema import Recipe
from cpunet.training.compared import Compared, Judged
from cpunet.training.half_maximum_alignment import at_half_maximum
from cpunet.training.outside import MIN_SCALE, Outside, of_height, tolerance

LATEST = 60  # samples after the expected half maximum from which it is searched for backward


class ChainStep:
    """Compute everything that a step compares if there is a chain.

    Parameters
    ----------
    chain, inverse
        Matched chain, and its inverse.
    ren, iren
        Residual U-Nets.
    recipe
        Recipe with a chain.
    """

    def __init__(
        self,
        chain: ResponseGenerator,
        inverse: LinearInverse,
        ren: PositionalUNet,
        iren: PositionalUNet,
        recipe: Recipe,
    ) -> None:
        self.preparation, self.matching = recipe.preparation, recipe.of_chain.matching.training
        before, after = self.matching.before, self.matching.after
        self.chain, self.inverse = chain, inverse
        device = next(ren.parameters()).device
        level = self.preparation.tail_level
        self.correction = UNetCorrection(ren, before, after, level).to(device)
        self.iren = InverseUNet(inverse, iren, before, after)

    def __call__(self, sim: Tensor, data: Tensor, rows: Tensor, outside: Outside) -> Compared:
        """Translate a batch of each side, shapes (batch, 1, samples), and back."""
        fake, start = outside.dress(self.records(sim[:, 0]), rows)
        cycled_sim, began = self.iren.located(fake[:, 0])
        wanted_sim = self._moved(sim[:, 0], start + began)
        fake_sim, first = self.iren.located(data[:, 0])
        data_near = stretch(data[:, 0], first, 0, self.length)
        sim_near = self._moved(sim[:, 0], self._near(sim[:, 0]) + PADDING_BEFORE)
        return Compared(
            identity_data=(data_near + self.correction.added(data_near), data_near),
            identity_sim=(self.iren.unet(sim_near[:, None])[:, 0], sim_near),
            cycle_forward=(cycled_sim, wanted_sim),
            cycle_backward=(self._back(fake_sim, data_near), data_near),
            judged_data=Judged(self.data_view(data), self.data_view(fake)),
            judged_sim=Judged(self.sim_view(sim_near), self.sim_view(fake_sim)),
            tolerance=tolerance(data, self.preparation)[:, 0],
        )

    @property
    def length(self) -> int:
        """Samples that the U-Nets see."""
        return self.matching.before + self.matching.after

    def records(self, sim: Tensor) -> Tensor:
        """Noise-free records of simulated windows, shape (batch, samples)."""
        records: Tensor = self.correction(self._by_chain(sim))
        return records

    def pairs(self, sim: Tensor, rows: Tensor, outside: Outside) -> tuple[Tensor, Tensor]:
        """Output of IREN for translated pulses, and its target."""
        fake, start = outside.dress(self._by_chain(sim[:, 0]), rows)
        pulses, began = self.iren.located(fake[:, 0])
        return pulses, self._moved(sim[:, 0], start + began)

    def data_view(self, windows: Tensor) -> Tensor:
        """Measured or translated windows, (batch, 1, samples), for the discriminator."""
        level = float(self.inverse.half_height)
        last, tail = self.preparation.samples_before + 1, self.preparation.tail_level
        return at_half_maximum(windows[:, 0], level, last, self.matching, tail)[:, None]

    def sim_view(self, near: Tensor) -> Tensor:
        """Charge around its half maximum, (batch, samples), for the discriminator."""
        last = self.matching.before + LATEST
        return at_half_maximum(near, 0.5, last, self.matching, 1.0)[:, None]

    @torch.no_grad()
    def _by_chain(self, sim: Tensor) -> Tensor:
        return of_height(self.chain.response(sim), self.preparation.tail_level)

    def _moved(self, sim: Tensor, sample: Tensor) -> Tensor:
        """Simulated pulses from a given sample of their records on."""
        return stretch(sim, sample - PADDING_BEFORE, 0, self.length)

    def _near(self, sim: Tensor) -> Tensor:
        highest, at = sim.max(dim=1, keepdim=True)
        return half_sample(sim, highest, at) - self.matching.before

    def _back(self, pulses: Tensor, data_near: Tensor) -> Tensor:
        """Charge translated by chain and REN, scaled to the measured pulse it came from."""
        records: Tensor = self.correction(
            of_height(self.chain.response(pulses), self.preparation.tail_level)
        )
        near = records[:, PADDING_BEFORE : PADDING_BEFORE + self.length]
        level = near[:, -TAIL:].mean(dim=1, keepdim=True).clamp_min(MIN_SCALE)
        return near * (data_near[:, -TAIL:].mean(dim=1, keepdim=True) / level)
