"""Rates of the pulse simulation on one core, and the library against the exact drift.

Run with ``python benchmarks/signals.py``; takes about a minute.
"""

from __future__ import annotations

import time

import numba
import numpy as np
import numpy.typing as npt

from cpunet.simulation.events import INTERPOLATED, NO_SIGNAL, EventPulses, simulate_events
from cpunet.simulation.fields import FieldMaps, compute_fields
from cpunet.simulation.gammas.sample import simulate_gammas
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.library import build_library
from cpunet.simulation.settings import SimulationSettings

EXACT_HITS, LIBRARY_HITS, GAMMAS = 6000, 200_000, 100_000
MAX_HITS_PER_EVENT = 5


def random_events(fields: FieldMaps, n_hits: int, seed: int) -> Hits:
    """Events of one to five hits, anywhere in the crystal's cylinder."""
    rng = np.random.default_rng(seed)
    radius = fields.r_mm[-1] * np.sqrt(rng.random(n_hits))
    phi = rng.uniform(0, 2 * np.pi, n_hits)
    z = rng.uniform(0, fields.z_mm[-1], n_hits)
    place = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)
    ends = np.cumsum(rng.integers(1, MAX_HITS_PER_EVENT + 1, n_hits))
    offsets = np.concatenate([[0], ends[ends < n_hits], [n_hits]])
    return Hits.of(place, rng.uniform(50, 1000, n_hits), offsets)


def timed(
    fields: FieldMaps, hits: Hits, settings: SimulationSettings, **how: object
) -> tuple[EventPulses, float]:
    """Return the events and the rate of hits with a signal."""
    start = time.perf_counter()
    events = simulate_events(fields, hits, settings, **how)  # type: ignore[arg-type]
    seconds = time.perf_counter() - start
    return events, np.sum(events.outcome != NO_SIGNAL) / seconds


def three(values: npt.NDArray[np.floating]) -> str:
    """Median, 99 % and worst of absolute values."""
    absolute = np.abs(values)
    numbers = (np.median(absolute), np.quantile(absolute, 0.99), absolute.max())
    return "median {:.2e}, 99 % {:.2e}, worst {:.2e}".format(*numbers)


def main() -> None:
    numba.set_num_threads(1)
    detector, settings = read_detector("icpc"), SimulationSettings()
    fields = compute_fields(detector)
    # compiled, or taken from the compiler's cache, before anything is timed
    quick = settings.model_copy(update={"library_grid_mm": 20.0, "library_halvings": 0})
    for library in (None, build_library(fields, quick)):
        simulate_events(fields, random_events(fields, 10, 0), quick, library)

    start = time.perf_counter()
    library = build_library(fields, settings)
    seconds = time.perf_counter() - start
    megabytes = sum(np.asarray(part).nbytes for part in library) / 1e6
    print(f"library: built in {seconds:.1f} s, {len(library.start)} pulses, {megabytes:.0f} MB")

    gammas, _ = simulate_gammas(
        detector, source_height_mm=20, source_radius_mm=5, n_primaries=GAMMAS, seed=1
    )
    samples = {"uniform": random_events(fields, LIBRARY_HITS, 1), "gammas": gammas}
    for name, hits in samples.items():
        many, rate = timed(fields, hits, settings, library=library)
        share = np.mean(many.outcome[many.outcome != NO_SIGNAL] == INTERPOLATED)
        print(f"library, {name}: {rate:.0f} hits/s, {100 * share:.2f} % interpolated")

    few = random_events(fields, EXACT_HITS, 2)
    exact, rate = timed(fields, few, settings)
    print(f"exact: {rate:.0f} hits/s")
    interpolated, _ = timed(fields, few, settings, library=library)
    kept = exact.collected_kev > 0
    pulses = [events.waveforms[kept].astype(float) for events in (interpolated, exact)]
    rise = [np.diff(p, axis=1, prepend=0).max(axis=1) for p in pulses]
    print(f"RMS of all samples: {np.sqrt(np.mean((pulses[0] - pulses[1]) ** 2)):.2e}")
    print("RMS:", three(np.sqrt(np.mean((pulses[0] - pulses[1]) ** 2, axis=1))))
    print("worst sample:", three(np.abs(pulses[0] - pulses[1]).max(axis=1)))
    print("I_max, relative:", three(rise[0] / rise[1] - 1))


if __name__ == "__main__":
    main()
