"""Options of a translation."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cpunet.errors import CpunetError

NONE, LEARNED = "none", "learned"  # pile-up tails
MOST = 1e300  # of numbers that are finite
MAX_BITS = 24  # of whole numbers in single precision


@dataclass(frozen=True)
class Adc:
    """Raw traces in ADC counts, see `cpunet.translation.file_translation`.

    Parameters
    ----------
    adc_per_kev
        Maximum over the baseline in ADC counts per keV; that of the run's data by default.
    baseline
        Baseline in ADC counts; that of the run's data by default.
    length
        Samples of a trace; those of a window by default.
    n_pre
        Samples before 99.9 % of the maximum; those of a window by default.
    bits
        Bits of the counts, beyond which they are clipped; by default as many as those of the
        run's data need.
    """

    adc_per_kev: float | None = None
    baseline: float | None = None
    length: int | None = None
    n_pre: int | None = None
    bits: int | None = None


@dataclass(frozen=True)
class TranslateOptions:
    """How to translate, see `cpunet.translate`; `adc` is None for normalised windows.

    Raises
    ------
    CpunetError
        If a value is out of range, or options contradict each other.
    """

    inverse: bool = False
    noise: bool = True
    seed: int = 0
    table: str | None = None
    adc: Adc | None = None
    tails: str | float = NONE
    pile_up_khz: float = 0.0

    def __post_init__(self) -> None:
        adc = self.adc or Adc()
        try:
            rate = 0.0 if self.tails in (NONE, LEARNED) else float(self.tails)
        except ValueError:
            rate = math.nan
        limits = {
            "seed": (self.seed, 0, 2**64 - 1, "a whole number from 0 to 2^64 - 1"),
            "tails": (rate, 0, MOST, "learned, none, or a rate in kHz"),
            "pile_up_khz": (self.pile_up_khz, 0, MOST, "a rate in kHz, 0 or more"),
            "adc_per_kev": (adc.adc_per_kev, 1 / MOST, MOST, "a number above 0"),
            "baseline": (adc.baseline, 0, MOST, "a number that is not negative"),
            "bits": (adc.bits, 1, MAX_BITS, f"1 to {MAX_BITS}"),
        }
        for name, (value, low, high, expected) in limits.items():
            if not (value is None or low <= value <= high):
                given = self.tails if name == "tails" else value
                raise CpunetError(f"`{name}` is {given}; expected {expected}")
        if self.table is not None and not self.table.strip("/ "):
            raise CpunetError("`out_table` is empty; leave it out, or give a name as geds/ren")
        others = {"tails": self.tails != NONE, "pile_up_khz": self.pile_up_khz > 0}
        for name, asked in {**others, "adc": self.adc is not None}.items():
            if asked and self.inverse:
                raise CpunetError(
                    f"`{name}`: the inverse gives charge, without other pulses and ADC counts; "
                    f"leave out `{name}`"
                )
            if asked and name in others and not self.noise:
                raise CpunetError(
                    f"`{name}`: other pulses are drawn with the noise; leave out `{name}`, or "
                    "translate with noise"
                )
