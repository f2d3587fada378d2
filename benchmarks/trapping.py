"""Effects of trapping on A/E and late charge.

    python benchmarks/trapping.py RUN [--detector icpc]

Pulses of hits throughout the crystal have the response of RUN's readout chain, without noise
and decays.  Changes are medians with the range from 16 to 84 %.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import scipy.fft

from cpunet.legend.currents import PEAK, currents_about_peak
from cpunet.networks.generators import ResponseGenerator
from cpunet.simulation.fields import FieldMaps, compute_fields
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator
from cpunet.training.chain_description import StepResponse, learned_chain
from cpunet.translation.translator import REN

LENGTH, PLATEAU = 12_000, 10_000  # ns
HITS = 500
TRAPPING = ("hole_trapping_per_us", "electron_trapping_per_us")


def settings(**more: float) -> SimulationSettings:
    """Settings with samples of 1 ns and the length of the record."""
    return SimulationSettings(dt_ns=1.0, length_ns=LENGTH, **more)


def told(undecayed: StepResponse, fine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A/E, and late charge in ns: area missing after 80 % of the charge at 10 us."""
    step = undecayed(np.arange(LENGTH, dtype=float))
    size = scipy.fft.next_fast_len(2 * LENGTH, real=True)
    impulse = scipy.fft.rfft(np.diff(step, prepend=0.0), size)
    signal = scipy.fft.irfft(scipy.fft.rfft(fine.astype(float), size) * impulse, size)
    signal = signal[:, :LENGTH] / signal[:, PLATEAU : PLATEAU + 1]
    currents, _ = currents_about_peak(signal)
    late = np.arange(PLATEAU) > (signal < 0.8).argmin(axis=1)[:, None]
    return currents[..., PEAK], ((1 - signal[:, :PLATEAU]) * late).sum(axis=1)


def of_trapping(chain: StepResponse, detector: Detector, fields: FieldMaps) -> None:
    """Print what each kind of trapping changes."""
    rng = np.random.default_rng(0)
    r = detector.crystal_radius * np.sqrt(rng.random(4 * HITS))
    z = detector.crystal_length * rng.random(4 * HITS)
    phi = rng.uniform(0, 2 * np.pi, 4 * HITS)
    places = (r * np.cos(phi), r * np.sin(phi), z)
    without = Simulator(detector, settings(), fields=fields).signals(*places, 1000.0)
    chosen = np.flatnonzero(without.valid & without.collected)[:HITS]
    x, y, z = (axis[chosen] for axis in places)
    amplitude, charge = told(chain, without.waveforms[chosen])
    print("trapping         collected   A/E             late charge ns")
    for name in TRAPPING:
        for rate in (0.005, 0.02):
            again = Simulator(detector, settings(**{name: rate}), fields=fields)
            with_it = again.signals(x, y, z, 1000.0)
            waveforms = with_it.waveforms
            a, lq = told(chain, waveforms / waveforms[:, -1:])
            lines = [
                np.quantile(change, (0.5, 0.16, 0.84))
                for change in (-100 * with_it.trapped, 100 * (a / amplitude - 1), lq - charge)
            ]
            print(
                f"{name.partition('_')[0]:9}{rate:g}/us  "
                + "  ".join(f"{m:+.3f} ({lo:+.3f} to {hi:+.3f})" for m, lo, hi in lines)
            )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--detector", default="icpc")
    given = parser.parse_args()
    generator = REN.load(given.run).backend.network
    assert isinstance(generator, ResponseGenerator), "a run of a readout chain"
    chain = learned_chain(generator.response, "run").undecayed
    detector = read_detector(given.detector)
    fields = compute_fields(detector)
    of_trapping(chain, detector, fields)


if __name__ == "__main__":
    main()
