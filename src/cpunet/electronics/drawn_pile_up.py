"""Random pile-up tails for translated pulses, distributed as in the data.

They are drawn from the law of the data. Quality cuts remove traces with large tails. The
probability of passing the cuts is measured by adding tails to measured traces without any.
Translations into prepared windows are compared with data after cuts, so their tails are
drawn with this probability. Raw traces have not passed any cuts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise, require_energies
from cpunet.electronics.exponentials import FloatArray as Values
from cpunet.electronics.pile_up_tails import PileUpTails, tail_shape
from cpunet.electronics.tails_law import TailsLaw
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import CutWindows, apply_cuts, prepare
from cpunet.recipes.schema import PreparationConfig
from cpunet.settings import plain

# Tails in keV at which the probability of passing the cuts is measured.
SIZES_KEV = (0.0, *np.geomspace(3.0, 3000.0, 25).tolist())
TEMPLATES, MIN_TEMPLATES = 150, 20  # traces to which tails are added


class KnownDecay(NamedTuple):
    """Decay time in us and its relative error."""

    us: float
    relative_error: float


@dataclass(frozen=True, eq=False)
class DrawnTails:
    """Tails to be drawn and added to records.

    Parameters
    ----------
    law
        Law from which they are drawn, at the start of a trace as long as the data's.
    height
        Height of a 1 keV pulse in prepared units times keV: about the maximum of a window.
    lead_us
        Delay of the start of a record relative to these traces, in us.
    dt_ns
        Sampling period in ns.
    passed
        Probability of passing the cuts of the data at `SIZES_KEV`. None if there are no cuts.
    decay_error_us
        Error in us of the decay time of the law, if it was measured from tails.
    """

    law: TailsLaw
    height: float
    lead_us: float
    dt_ns: float
    passed: tuple[float, ...] | None = None
    decay_error_us: float | None = None

    @property
    def known_decay(self) -> KnownDecay | None:
        """The decay time, if it was measured from tails."""
        if self.decay_error_us is None:
            return None
        return KnownDecay(self.law.decay_us, self.decay_error_us / self.law.decay_us)

    def uncut(self, rate_khz: float | None = None) -> Self:
        """Copy without cuts, optionally with another rate in kHz."""
        law = self.law if rate_khz is None else replace(self.law, rate_khz=rate_khz)
        return replace(self, law=law, passed=None)

    def draw_kev(self, n: int, rng: np.random.Generator) -> Values:
        """Draw the tails at the start of `n` traces, in keV."""
        kev = self.law.draw(n, rng)
        if self.passed is None or not n:
            return kev
        again = np.arange(n)
        for _ in range(100):  # most traces have no tail and pass
            sizes = np.log1p(kev[again])
            passes = np.interp(sizes, np.log1p(SIZES_KEV), self.passed)
            again = again[rng.random(len(again)) >= passes]
            if not len(again):
                break
            kev[again] = self.law.draw(len(again), rng)
        return kev

    def decay(self, length: int, lead_us: float | None = None) -> Values:
        """Tail of 1 keV at each sample of a record, shape ``(length,)``."""
        lead = self.lead_us if lead_us is None else lead_us
        time_us = np.arange(length) * self.dt_ns * 1e-3 + lead
        return np.asarray(np.exp(-time_us / self.law.decay_us), float)

    def factors(
        self, energy_kev: npt.NDArray[np.float64], rng: np.random.Generator
    ) -> FloatArray:
        """Draw tails for pulses of given energies, in prepared units."""
        require_energies(energy_kev)
        kev = self.draw_kev(len(energy_kev), rng)
        return np.asarray(kev * self.height / energy_kev, np.float32)

    def describe(self) -> dict[str, Any]:
        """Serialise to a mapping that `of` reads."""
        told: dict[str, Any] = plain(asdict(self))
        del told["decay_error_us"]
        return {**told.pop("law"), **told}

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Self:
        """Read a mapping written by `describe`."""
        law = TailsLaw(told["rate_khz"], told["decay_us"], tuple(told["energies_kev"]))
        passed = None if told["passed"] is None else tuple(told["passed"])
        return cls(law, told["height"], told["lead_us"], told["dt_ns"], passed)


@dataclass(frozen=True, eq=False)
class TraceNoise:
    """Noise and pile-up tails: everything that is added to a record.

    Parameters
    ----------
    noise
        Noise of the baselines.
    tails
        Pile-up tails, or None for noise alone.
    """

    noise: BaselineNoise
    tails: DrawnTails | None = None

    @property
    def dt_ns(self) -> float:
        """Sampling period of the noise in ns."""
        return self.noise.dt_ns

    def draw(
        self, energy_kev: npt.NDArray[np.float64], length: int, rng: np.random.Generator
    ) -> FloatArray:
        """Draw noise as `BaselineNoise.draw`, with pile-up tails added."""
        drawn = self.noise.draw(energy_kev, length, rng)
        if self.tails is not None:
            factors = self.tails.factors(energy_kev, rng)
            drawn += factors[:, np.newaxis] * self.tails.decay(length).astype(np.float32)
        return drawn


class SameNoise:
    """Noise that several methods add to the same records in turn, drawn only once.

    Parameters
    ----------
    noise
        Noise of the records.
    """

    def __init__(self, noise: BaselineNoise | TraceNoise) -> None:
        self._noise = noise
        # arguments of the last draw, its result, and the state of the generator after it
        self._last: tuple[Any, FloatArray, Any] | None = None

    @property
    def dt_ns(self) -> float:
        """Sampling period of the noise in ns."""
        return self._noise.dt_ns

    def draw(
        self, energy_kev: npt.NDArray[np.float64], length: int, rng: np.random.Generator
    ) -> FloatArray:
        """Draw like the noise itself; repeat the last draw for the same generator state."""
        asked = (rng.bit_generator.state, energy_kev.tobytes(), length)
        if self._last is None or self._last[0] != asked:
            drawn = self._noise.draw(energy_kev, length, rng)
            self._last = asked, drawn, rng.bit_generator.state
        _, drawn, rng.bit_generator.state = self._last
        return drawn.copy()


def passing(
    tails: PileUpTails, traces: Pulses, config: PreparationConfig, cuts: CutWindows
) -> tuple[float, ...] | None:
    """Probability that traces with tails of `SIZES_KEV` pass the quality cuts.

    Parameters
    ----------
    tails
        Tails of the channel.
    traces
        Raw traces that have passed the cuts.
    config, cuts
        Preparation settings and quality cuts.

    Returns
    -------
    tuple of float
        One probability per size, or None if too few traces have no tail.
    """
    raw = traces.waveforms[tails.measure(traces) < tails.error_kev][:TEMPLATES]
    if len(raw) < MIN_TEMPLATES:
        return None
    shape = tail_shape(raw.shape[1], tails.dt_ns, tails.decay_us)
    unit = (tails.adc_per_kev * shape).astype(np.float32)
    shares = []
    for kev in SIZES_KEV:
        lifted = Pulses.of(raw + np.float32(kev) * unit, dt_ns=tails.dt_ns)
        shares.append(len(apply_cuts(prepare(lifted, config, "measured"), cuts)) / len(raw))
    return tuple(share / max(shares[0], 1e-9) for share in np.minimum.accumulate(shares))
