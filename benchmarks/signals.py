"""Rates of the pulse simulation on one core; ``python benchmarks/signals.py DETECTOR.yaml``."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numba
import numpy as np
import yaml

from cpunet.simulation.events import simulate_events
from cpunet.simulation.fields import compute_fields
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.library import build_library
from cpunet.simulation.settings import SimulationSettings

N = 4000


def main() -> None:
    numba.set_num_threads(1)
    detector = Detector(**yaml.safe_load(Path(sys.argv[1]).read_text("utf-8")))
    fields, settings = compute_fields(detector), SimulationSettings()
    top = [fields.r_mm[-1], fields.r_mm[-1], fields.z_mm[-1]]
    place = np.random.default_rng(0).uniform([-top[0], -top[1], 0], top, (N, 3))
    hits = Hits.of(place, np.full(N, 500.0), np.arange(N + 1))
    library = build_library(fields, settings)
    for mode in ("exact", "library"):
        simulate_events(fields, hits[:5], settings, mode, library=library)
        start = time.perf_counter()
        events = simulate_events(fields, hits, settings, mode, library=library)
        seconds = time.perf_counter() - start
        drifted = int((events.lost_kev == 0).sum())
        print(f"{mode}: {drifted / seconds:.0f} pulses/s")


if __name__ == "__main__":
    main()
