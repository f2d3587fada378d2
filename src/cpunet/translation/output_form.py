"""In which form translated pulses are given out: here as they come, normalised windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

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
    """

    pulses: Pulses
    codes: Codes
    saturated: npt.NDArray[np.bool_]


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
    """

    samples: npt.DTypeLike = np.float32
    units = ""

    def __init__(self, translator: Translator) -> None:
        self.translator = translator
        self.t0_ns = -translator.recipe.preparation.samples_before * translator.dt_ns

    def __call__(
        self, pulses: Pulses, *, noise: bool, generator: torch.Generator | None
    ) -> Formed:
        """Translate pulses, keeping their rows."""
        done = self.translator.translate_pulses(pulses, noise=noise, generator=generator)
        return Formed(done.pulses, done.codes, np.zeros(len(pulses), bool))
