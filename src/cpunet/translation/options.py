"""Options of a translation."""

from __future__ import annotations

from dataclasses import dataclass

from cpunet.errors import CpunetError

NONE, LEARNED = "none", "learned"  # pile-up tails


@dataclass(frozen=True)
class Adc:
    """Raw traces in ADC counts, see `cpunet.translation.forms.Form`.

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
        If options contradict each other.
    """

    inverse: bool = False
    noise: bool = True
    seed: int = 0
    table: str | None = None
    adc: Adc | None = None
    tails: str | float = NONE
    pile_up_khz: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**64:
            raise CpunetError(f"`seed` {self.seed}: expected a whole number from 0 to 2^64 - 1")
        if self.table is not None and not self.table.strip("/ "):
            raise CpunetError("`out_table` is empty; leave it out, or give a name as geds/ren")
        asked = {
            "tails": self.tails != NONE,
            "pile_up_khz": self.pile_up_khz != 0,
            "adc": self.adc is not None,
        }
        for name in (name for name in asked if asked[name]):
            if self.inverse:
                raise CpunetError(
                    f"`{name}`: the inverse gives charge, without other pulses and ADC counts; "
                    f"leave out `{name}`"
                )
            if not self.noise and name != "adc":
                raise CpunetError(
                    f"`{name}`: other pulses are drawn with the noise; leave out `{name}`, or "
                    "translate with noise"
                )
