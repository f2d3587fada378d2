"""From ideal pulses to raw traces as a digitiser writes them, with the truth kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.electronics.chain import REFERENCE_KEV, Electronics
from cpunet.electronics.exact_response import distorted, linear_response, required_energy_kev
from cpunet.electronics.exponentials import FloatArray
from cpunet.electronics.noise_traces import noise_of
from cpunet.electronics.other_pulses import draw_other_pulses
from cpunet.pulses.container import Pulses
from cpunet.simulation.gammas.sample import with_resolution

DECAYING_BASELINE, PILE_UP, SATURATED = 1, 2, 4
"""Bits of a trace's flags. A baseline decays if its remainder exceeds the noise RMS."""


@dataclass(frozen=True, eq=False)
class RawTraces:
    """Raw traces and the truth behind them.

    Parameters
    ----------
    waveforms
        ADC counts, uint16, shape ``(n, length)``.
    dt_ns
        Sampling period in ns.
    energy_kev
        Calibrated energies in keV, including the energy resolution.
    event_number
        Event numbers of the source.
    flags
        Uint8 sum of 1 (decaying baseline), 2 (pile-up) and 4 (saturated).
    response
        Noise-free pulses at their own clock phase in units of the full charge, without
        baseline and without earlier or second pulses. Float32, shape ``(n, length)``.
    true_energy_kev, baseline_adc
        Scale in keV and offset in ADC counts of each pulse.
    remains_kev, n_piled, piled_kev
        Properties of other pulses, see `cpunet.electronics.other_pulses.OtherPulses`.
    piled_ns
        Start of the largest additional pulse after that of the trace's own pulse in ns
        (negative: before it). NaN where there is none.
    """

    waveforms: npt.NDArray[np.uint16]
    dt_ns: float
    energy_kev: FloatArray
    event_number: npt.NDArray[np.int64]
    flags: npt.NDArray[np.uint8]
    response: npt.NDArray[np.float32]
    true_energy_kev: FloatArray
    baseline_adc: FloatArray
    remains_kev: FloatArray
    n_piled: npt.NDArray[np.int64]
    piled_kev: FloatArray
    piled_ns: FloatArray

    def __len__(self) -> int:
        return len(self.waveforms)


def read_out(pulses: Pulses, electronics: Electronics, seed: int) -> RawTraces:
    """Pass ideal pulses through a readout chain.

    Parameters
    ----------
    pulses
        Charge pulses from 0 to 1 with true energies, sampled more finely than the digitiser
        (1 to 4 ns). All are held in memory: split large sets into blocks.
    electronics
        The readout chain.
    seed
        Seed of the random generator. The same seed gives the same traces.

    Raises
    ------
    CpunetError
        For the reasons of `cpunet.electronics.exact_response.respond` and `noise_of`.

    Examples
    --------
    >>> from cpunet.electronics.chain import read_electronics
    >>> step = Pulses.of(np.ones((2, 900)), dt_ns=4, energy_kev=[1592.5, 2614.5])
    >>> traces = read_out(step, read_electronics("legend200"), seed=1)
    >>> traces.waveforms.shape, traces.waveforms.dtype
    ((2, 1400), dtype('uint16'))
    """
    energy, n = required_energy_kev(pulses), len(pulses)
    clock, others, noise, level, resolution = np.random.default_rng(seed).spawn(5)
    shift_ns = _shift_ns(electronics, n, clock)
    linear = linear_response(pulses, electronics, shift_ns)
    own_kev = energy[:, None] * linear
    other = draw_other_pulses(pulses, electronics, others)
    total_kev = own_kev + other.added_kev
    response = linear
    if electronics.non_linearity is not None:
        figures, dt_ns = electronics.non_linearity, electronics.dt_ns
        response = distorted(own_kev, figures, dt_ns) / energy[:, None]
        total_kev = distorted(total_kev, figures, dt_ns)
    total_kev += noise_of(electronics, n, noise)
    baseline = level.normal(
        electronics.baseline_mean_adc, electronics.baseline_spread_adc, size=n
    )
    adc = np.rint(baseline[:, None] + electronics.gain_adc_per_kev * total_kev)
    beyond = (adc > electronics.adc_top) | (adc < 0)
    flags = (
        np.where(other.remains_kev > electronics.noise.rms_kev, DECAYING_BASELINE, 0)
        | np.where(other.n_piled > 0, PILE_UP, 0)
        | np.where(beyond.any(axis=1), SATURATED, 0)
    ).astype(np.uint8)
    return RawTraces(
        waveforms=np.clip(adc, 0, electronics.adc_top).astype(np.uint16),
        dt_ns=electronics.dt_ns,
        energy_kev=with_resolution(
            energy,
            noise_kev2=0.0,
            fano_kev=electronics.resolution_fwhm_kev**2 / REFERENCE_KEV,
            seed=int(resolution.integers(2**63)),
        ),
        event_number=pulses.event_number,
        flags=flags,
        response=response.astype(np.float32),
        true_energy_kev=energy,
        baseline_adc=baseline,
        remains_kev=other.remains_kev,
        n_piled=other.n_piled,
        piled_kev=other.piled_kev,
        piled_ns=other.piled_ns - shift_ns,
    )


def _shift_ns(electronics: Electronics, n: int, rng: np.random.Generator) -> FloatArray:
    """Start of the pulses after `n_pre` samples: a uniform clock phase plus trigger jitter."""
    phase = rng.uniform(0, electronics.dt_ns, size=n)
    return phase + rng.normal(0, electronics.trigger_jitter_ns, size=n)
