"""Inputs of a CycleGAN besides its pulses: noise, a matched chain, a teacher."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.networks.linear_inverse import LinearInverse
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.training.outside import Outside


class MatchedChain(NamedTuple):
    """A readout chain with its noise, and its inverse."""

    generator: ResponseGenerator
    inverse: LinearInverse


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Inputs of a CycleGAN besides its pulses.

    Parameters
    ----------
    outside
        Noise for the translations of the simulated pulses.
    chain
        Matched chain that the generators follow.
    teacher
        A matched chain that makes pairs for generators without one, with its noise.
    """

    outside: Outside | None = None
    chain: MatchedChain | None = None
    teacher: tuple[ResponseGenerator, Outside] | None = None

    def of_pulses(self, rows: npt.NDArray[np.int64]) -> Surroundings:
        """The same for some of the simulated pulses; a teacher requires all of them."""
        if self.outside is None:
            return self
        outside = replace(self.outside, energy_kev=self.outside.energy_kev[rows])
        return replace(self, outside=outside)


NONE = Surroundings()
