"""Output forms of translated pulses; this module defines normalised windows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from cpunet.electronics.drawn_tails import DrawnTails
from cpunet.electronics.in_trace_pile_up import Columns, DrawnPileUp, InTracePileUp
from cpunet.networks.response_layer import PADDING_BEFORE, record_length
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
    truth
        What is known of each trace, arrays of shape (n,) with their units: ``tails_kev``
        with pile-up tails; ``n_piled``, ``piled_kev`` and ``piled_ns`` with in-trace pile-up,
        see `InTracePileUp.largest`; ``realisation`` with several.
    """

    pulses: Pulses
    codes: Codes
    saturated: npt.NDArray[np.bool_]
    truth: Columns = field(default_factory=dict)

    @property
    def columns(self) -> Columns:
        """Columns to be stored beside the pulses."""
        return {"rejection": (self.codes, ""), **self.truth}


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
    tails
        Distribution of the pile-up tails; None for none.
    pile_up
        Rate and energies of piled-up pulses; None for none.
    """

    samples: npt.DTypeLike = np.float32
    units = ""

    def __init__(
        self,
        translator: Translator,
        tails: DrawnTails | None = None,
        pile_up: DrawnPileUp | None = None,
    ) -> None:
        self.translator, self.tails, self.pile_up = translator, tails, pile_up
        self.t0_ns = -translator.recipe.preparation.samples_before * translator.dt_ns

    def __call__(
        self, pulses: Pulses, *, noise: bool, generator: torch.Generator | None
    ) -> Formed:
        """Translate pulses, keeping their rows."""
        left = drawn_kev(self.tails, len(pulses), generator)
        piled = self._piled(len(pulses), generator)
        done = self.translator.translate_pulses(
            pulses, noise=noise, generator=generator, tails_kev=left, piled=piled
        )
        saturated = np.zeros(len(pulses), bool)
        return Formed(done.pulses, done.codes, saturated, truth_of(left, piled))

    def _piled(self, n: int, generator: torch.Generator | None) -> InTracePileUp | None:
        """Draw piled-up pulses within the records that are prepared to windows."""
        if self.pile_up is None:
            return None
        config = self.translator.recipe.preparation
        before = PADDING_BEFORE + config.samples_before
        return self.pile_up.draw(n, before, record_length(config.length), rng_of(generator))


def drawn_kev(
    tails: DrawnTails | None, n: int, generator: torch.Generator | None
) -> npt.NDArray[np.float64] | None:
    """Pile-up tails of `n` pulses in keV, drawn from the random generator of the noise."""
    return None if tails is None else tails.draw_kev(n, rng_of(generator))


def truth_of(left: npt.NDArray[np.float64] | None, piled: InTracePileUp | None) -> Columns:
    """Columns on tails and on piled-up pulses, as far as there are any."""
    truth: Columns = {} if left is None else {"tails_kev": (left, "keV")}
    return truth if piled is None else truth | piled.columns()


def rng_of(generator: torch.Generator | None) -> np.random.Generator:
    """A NumPy generator, seeded by a draw from that of torch."""
    device = "cpu" if generator is None else generator.device
    seed = torch.randint(2**62, (), generator=generator, device=device)
    return np.random.default_rng(int(seed))
