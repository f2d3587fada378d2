"""In which form translated pulses are given out: here as they come, normalised windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from cpunet.electronics.drawn_remains import DrawnRemains
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Codes
from cpunet.translation.translator import Translator


@dataclass(frozen=True, eq=False)
class Formed:
    """Translated pulses in the form of the output, row by row those that were given.

    Parameters
    ----------
    pulses
        Traces of shape (n, samples).
    codes
        A `Rejection` for each row.
    saturated
        Which rows reach an end of the digitiser's range, shape (n,).
    remains_kev
        What earlier pulses have left under each, in keV, shape (n,); None for none at all.
    """

    pulses: Pulses
    codes: Codes
    saturated: npt.NDArray[np.bool_]
    remains_kev: npt.NDArray[np.float64] | None = None


class OutputForm(Protocol):
    """A form of output: translates pulses and says what its samples are.

    Attributes
    ----------
    samples : numpy dtype
        Type in which samples are stored.
    units : str
        Of the samples.
    t0_ns : float
        Time of the first sample; 0 is where a pulse reaches 99.9 % of its maximum.
    """

    samples: npt.DTypeLike
    units: str
    t0_ns: float

    def __call__(
        self, pulses: Pulses, *, noise: bool, generator: torch.Generator | None
    ) -> Formed:
        """Translate pulses, keeping their rows."""
        ...


class Normalised:
    """Prepared windows: baseline at 0, tail at 0.80; NaN for pulses that were rejected.

    Parameters
    ----------
    translator
        A trained run.
    remains
        Of earlier pulses, to be drawn; None for none.
    """

    samples: npt.DTypeLike = np.float32
    units = ""

    def __init__(self, translator: Translator, remains: DrawnRemains | None = None) -> None:
        self.translator, self.remains = translator, remains
        self.t0_ns = -translator.recipe.preparation.samples_before * translator.dt_ns

    def __call__(
        self, pulses: Pulses, *, noise: bool, generator: torch.Generator | None
    ) -> Formed:
        """Translate pulses, keeping their rows."""
        left = drawn_kev(self.remains, len(pulses), generator)
        done = self.translator.translate_pulses(
            pulses, noise=noise, generator=generator, remains_kev=left
        )
        return Formed(done.pulses, done.codes, np.zeros(len(pulses), bool), left)


def drawn_kev(
    remains: DrawnRemains | None, n: int, generator: torch.Generator | None
) -> npt.NDArray[np.float64] | None:
    """Remains of `n` pulses in keV, from the generator that the noise comes from."""
    if remains is None:
        return None
    device = "cpu" if generator is None else generator.device
    seed = torch.randint(2**62, (), generator=generator, device=device)
    return remains.draw_kev(n, np.random.default_rng(int(seed)))
