"""Time for field maps, solved and read from the cache, and rates of pulses on one core.

Run with ``python benchmarks/signals.py``; takes about half a minute.
"""

from __future__ import annotations

import os
import tempfile
import time

import numba
import numpy as np

from cpunet.simulation.fields import compute_fields
from cpunet.simulation.gammas import simulate_gammas
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import detector_names, read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator

HITS, GAMMAS = 20_000, 10_000
MAX_HITS_PER_EVENT = 5


def random_events(detector: Detector, n_hits: int, seed: int) -> Hits:
    """Events of one to five hits, anywhere in the crystal's cylinder."""
    rng = np.random.default_rng(seed)
    radius = detector.crystal_radius * np.sqrt(rng.random(n_hits))
    phi = rng.uniform(0, 2 * np.pi, n_hits)
    z = rng.uniform(0, detector.crystal_length, n_hits)
    place = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)
    ends = np.cumsum(rng.integers(1, MAX_HITS_PER_EVENT + 1, n_hits))
    offsets = np.concatenate([[0], ends[ends < n_hits], [n_hits]])
    return Hits.of(place, rng.uniform(50, 1000, n_hits), offsets)


def fields() -> None:
    """Field maps of the detectors of the package."""
    for name in detector_names():
        detector, seconds = read_detector(name), []
        with tempfile.TemporaryDirectory() as folder:
            os.environ["CPUNET_CACHE"] = folder
            for _ in range(2):
                start = time.perf_counter()
                maps = compute_fields(detector)
                seconds.append(time.perf_counter() - start)
        shape = " x ".join(map(str, maps.potential_V.shape))
        print(
            f"{name}: {shape} nodes, solved {seconds[0]:.2f} s, cached {seconds[1]:.3f} s; "
            f"{maps.capacitance_pF:.3f} pF, depleted at {maps.depletion_V:.0f} V"
        )
    del os.environ["CPUNET_CACHE"]


def main() -> None:
    fields()
    numba.set_num_threads(1)
    detector = read_detector("icpc")
    gammas, _ = simulate_gammas(
        detector, source_height_mm=20, source_radius_mm=5, n_primaries=GAMMAS, seed=1
    )
    for step_ns in (1.0, 2.0):
        simulator = Simulator(detector, SimulationSettings(step_ns=step_ns))
        simulator.events(random_events(detector, 10, 0))  # compiled before anything is timed
        samples = {"uniform": random_events(detector, HITS, 1), "gammas": gammas}
        for name, hits in samples.items():
            start = time.perf_counter()
            events = simulator.events(hits)
            rate = events.valid.sum() / (time.perf_counter() - start)
            print(f"steps of {step_ns:g} ns, {name}: {rate:.0f} hits/s")


if __name__ == "__main__":
    main()
