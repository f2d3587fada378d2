"""Output forms of translated pulses; this module defines normalised windows."""

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
    """Translated pulses in the form of the output, with the rows of the input.

    Parameters
    ----------
    pulses
        Traces of shape (n, samples).
    codes
        A `Rejection` for each row.
    saturated
        Mask of the rows that reach an end of the digitiser's range, shape (n,).
    remains_kev
        Remains of earlier pulses under each pulse in keV, shape (n,); None without remains.
    """

    pulses: Pulses
    codes: Codes
    saturated: npt.NDArray[np.bool_]
    remains_kev: npt.NDArray[np.float64] | None = None


class OutputForm(Protocol):
    """An output form: translates pulses and defines type and units of the samples.

    Attributes
    ----------
    samples : numpy dtype
        Data type of the stored samples.
    units : str
        Units of the samples.
    t0_ns : float
        Time of the first sample in ns, counted from where a pulse reaches 99.9 % of its
        maximum.
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
    """Prepared windows: baseline at 0, tail at 0.80; NaN for rejected pulses.

    Parameters
    ----------
    translator
        Trained run.
    remains
        Distribution of the remains of earlier pulses; None for none.
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
    """Remains of `n` pulses in keV, drawn from the random generator of the noise."""
    if remains is None:
        return None
    device = "cpu" if generator is None else generator.device
    seed = torch.randint(2**62, (), generator=generator, device=device)
    return remains.draw_kev(n, np.random.default_rng(int(seed)))
