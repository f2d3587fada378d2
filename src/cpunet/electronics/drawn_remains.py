"""Remains of earlier pulses to be drawn: what a translation needs to have them like data.

They are drawn by the law of the data.  Quality cuts take traces with large ones: how likely a
remainder is to pass them is measured by adding remains to measured traces that have none, and
translations into prepared windows, which are compared with data behind these cuts, are drawn
accordingly.  Raw traces have not passed any.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise, require_energies
from cpunet.electronics.exponentials import FloatArray as Values
from cpunet.electronics.remains import Remains
from cpunet.electronics.remains_law import RemainsLaw
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.cuts import CutWindows, apply_cuts
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import PreparationConfig

# Sizes in keV at which it is measured how likely a remainder passes the cuts.
SIZES_KEV = (0.0, *np.geomspace(3.0, 3000.0, 25).tolist())
TEMPLATES, FEWEST_TEMPLATES = 150, 20  # traces that remains are added to


class KnownDecay(NamedTuple):
    """A decay in us, and its relative error."""

    us: float
    relative_error: float


@dataclass(frozen=True, eq=False)
class DrawnRemains:
    """Remains to be added to records.

    Parameters
    ----------
    law
        What they are drawn by, at the beginning of a trace as long as the data's.
    height
        Of a pulse of 1 keV in prepared units times keV: about the maximum of a window.
    lead_us
        By how much later records begin than these traces.
    dt_ns
        Sampling period.
    passed
        Probability to pass the data's cuts at `SIZES_KEV`; None if there are no cuts.
    decay_error_us
        Of the law's decay, if remains have told it themselves.
    """

    law: RemainsLaw
    height: float
    lead_us: float
    dt_ns: float
    passed: tuple[float, ...] | None = None
    decay_error_us: float | None = None

    @property
    def known_decay(self) -> KnownDecay | None:
        """The decay, if remains have told it."""
        if self.decay_error_us is None:
            return None
        return KnownDecay(self.law.decay_us, self.decay_error_us / self.law.decay_us)

    def uncut(self, rate_khz: float | None = None) -> Self:
        """The same without cuts, and at another rate if wanted."""
        law = self.law if rate_khz is None else replace(self.law, rate_khz=rate_khz)
        return replace(self, law=law, passed=None)

    def draw_kev(self, n: int, rng: np.random.Generator) -> Values:
        """What is left at the beginning of `n` traces, in keV."""
        kev = self.law.draw(n, rng)
        if self.passed is None or not n:
            return kev
        again = np.arange(n)
        for _ in range(100):  # nothing at all is left in most traces, and passes
            sizes = np.log1p(kev[again])
            passes = np.interp(sizes, np.log1p(SIZES_KEV), self.passed)
            again = again[rng.random(len(again)) >= passes]
            if not len(again):
                break
            kev[again] = self.law.draw(len(again), rng)
        return kev

    def decay(self, length: int, lead_us: float | None = None) -> Values:
        """What is left of 1 keV at the samples of a record."""
        lead = self.lead_us if lead_us is None else lead_us
        time_us = np.arange(length) * self.dt_ns * 1e-3 + lead
        return np.asarray(np.exp(-time_us / self.law.decay_us), float)

    def factors(
        self, energy_kev: npt.NDArray[np.float64], rng: np.random.Generator
    ) -> tuple[FloatArray, Values]:
        """Drawn remains for pulses of these energies, in prepared units and in keV."""
        require_energies(energy_kev)
        kev = self.draw_kev(len(energy_kev), rng)
        return np.asarray(kev * self.height / energy_kev, np.float32), kev

    def describe(self) -> dict[str, Any]:
        """As `of` reads it."""
        return {
            "rate_khz": self.law.rate_khz,
            "decay_us": self.law.decay_us,
            "energies_kev": list(self.law.energies_kev),
            "height": self.height,
            "lead_us": self.lead_us,
            "dt_ns": self.dt_ns,
            "passed": None if self.passed is None else list(self.passed),
        }

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Self:
        """Read what `describe` gave."""
        law = RemainsLaw(
            float(told["rate_khz"]), float(told["decay_us"]), tuple(told["energies_kev"])
        )
        passed = None if told["passed"] is None else tuple(told["passed"])
        return cls(
            law, float(told["height"]), float(told["lead_us"]), float(told["dt_ns"]), passed
        )


@dataclass(frozen=True, eq=False)
class TraceNoise:
    """Noise and remains together: all that is added to a record.

    Parameters
    ----------
    noise
        Of the baselines.
    remains
        None for noise alone.
    """

    noise: BaselineNoise
    remains: DrawnRemains | None = None

    @property
    def dt_ns(self) -> float:
        """Sampling period of the noise."""
        return self.noise.dt_ns

    def draw(
        self, energy_kev: npt.NDArray[np.float64], length: int, rng: np.random.Generator
    ) -> FloatArray:
        """As `BaselineNoise.draw`, with remains on top."""
        drawn = self.noise.draw(energy_kev, length, rng)
        if self.remains is not None:
            factors, _ = self.remains.factors(energy_kev, rng)
            drawn += factors[:, np.newaxis] * self.remains.decay(length).astype(np.float32)
        return drawn


def passing(
    remains: Remains, traces: Iterable[Pulses], config: PreparationConfig, cuts: CutWindows
) -> tuple[float, ...] | None:
    """Probability of remains of `SIZES_KEV` to pass quality cuts.

    Parameters
    ----------
    remains
        Of the traces' channel.
    traces
        Blocks of raw traces that have passed the cuts.
    config, cuts
        Preparation and cuts.

    Returns
    -------
    tuple of float
        None if there are too few traces without a remainder.
    """
    templates: list[npt.NDArray[np.float32]] = []
    for block in traces:
        empty = remains.measure(block) < remains.error_kev
        templates += list(block.waveforms[empty])
        if len(templates) >= TEMPLATES:
            break
    if len(templates) < FEWEST_TEMPLATES:
        return None
    raw = np.stack(templates[:TEMPLATES])
    time_us = np.arange(raw.shape[1]) * remains.dt_ns * 1e-3
    unit = remains.adc_per_kev * np.exp(-time_us / remains.decay_us)
    shares = []
    for kev in SIZES_KEV:
        lifted = Pulses.of(raw + np.float32(kev) * unit.astype(np.float32), dt_ns=remains.dt_ns)
        shares.append(len(apply_cuts(prepare(lifted, config, "measured"), cuts)) / len(raw))
    return tuple(share / max(shares[0], 1e-9) for share in np.minimum.accumulate(shares))
