"""Options of the translation of a file."""

from __future__ import annotations

from dataclasses import dataclass

from cpunet.errors import CpunetError
from cpunet.translation.learned_remains import NONE


@dataclass(frozen=True)
class Adc:
    """Output as raw traces in ADC counts, see `cpunet.translation.to_adc`."""

    adc_per_kev: float | None = None
    baseline: float | None = None
    length: int | None = None
    n_pre: int | None = None


@dataclass(frozen=True)
class TranslateOptions:
    """How to translate a file.

    Parameters
    ----------
    inverse
        Whether to apply IREN (data → simulation-like) instead of REN.
    noise, seed
        Whether to add noise, and its seed.
    table
        Table for the pulses in the LH5 file; ``geds/ren`` or ``geds/iren`` if None.
    realisations
        Number of noise draws for each pulse. Each draw is a row, numbered in the column
        ``realisation``.
    adc
        Raw traces in ADC counts instead of normalised windows.
    remains
        Remains of earlier pulses, with the column ``remains_kev``: ``"learned"`` (in windows as
        after the quality cuts of the data), ``"none"``, or a rate in kHz.
    pile_up_khz
        Rate in kHz of second pulses within a trace, with the columns ``n_piled``,
        ``piled_kev`` and ``piled_ns``: their number, and energy and time (relative to the
        trace's own pulse) of the largest.
    """

    inverse: bool = False
    noise: bool = True
    seed: int = 0
    table: str | None = None
    realisations: int | None = None
    adc: Adc | None = None
    remains: str = NONE
    pile_up_khz: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**64:
            raise CpunetError(f"seed {self.seed}: expected a whole number from 0 to 2^64 - 1")
        if self.realisations is not None and self.realisations < 1:
            raise CpunetError(f"--realisations is {self.realisations}; expected 1 or more")
        if (self.realisations or 1) > 1 and not self.noise:
            raise CpunetError("realisations without noise are all the same; give one of both")
        if self.table is not None and not self.table.strip("/ "):
            raise CpunetError("--out-table is empty; leave it out, or give a name as geds/ren")
        if self.remains != NONE and self.inverse:
            raise CpunetError("the inverse gives charge, without remains; leave out --remains")
        if self.remains != NONE and not self.noise:
            raise CpunetError("remains are drawn with the noise; leave out --no-noise")
        if self.pile_up_khz and self.inverse:
            raise CpunetError(
                "the inverse gives charge, without second pulses; leave out --pile-up-khz"
            )
        if self.pile_up_khz and not self.noise:
            raise CpunetError("second pulses are drawn with the noise; leave out --no-noise")
        if self.adc is not None and self.inverse:
            raise CpunetError("the inverse gives charge, no ADC counts; leave out --output adc")
