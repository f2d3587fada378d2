"""Built-in gamma transport on one core: gammas, double-escape events and sites per second.

Run with ``python benchmarks/gammas.py``; takes some ten seconds.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from cpunet.simulation.clustering import cluster_hits
from cpunet.simulation.gammas import WantedLine, simulate_gammas

N_EVENTS = 3_000
DEP = {"DEP": WantedLine(1591.0, 1594.0, N_EVENTS)}


@dataclass(frozen=True)
class Crystal:
    crystal_length: float = 96.0
    crystal_radius: float = 40.5
    bore_length: float = 69.9
    bore_radius: float = 5.0
    bore_bullet_radius: float = 0.0
    outer_taper_length: float = 0.0
    inner_taper_length: float = 0.0
    taper_angle_deg: float = 0.0
    wrap_around_radius: float = 14.0
    ditch_depth: float = 0.0
    ditch_thickness: float = 3.0


def main() -> None:
    common = {"source_height_mm": 20.0, "source_radius_mm": 5.0, "seed": 1}
    simulate_gammas(Crystal(), n_primaries=10, **common)  # compile
    start = time.process_time()
    hits, seen = simulate_gammas(Crystal(), n_primaries=10_000_000, wanted=DEP, **common)
    spent = time.process_time() - start
    print(f"{seen.n_primaries / spent:,.0f} gammas/s, {N_EVENTS / spent:,.0f} DEP events/s")
    cluster_hits(hits[:10], 1.5)
    start = time.process_time()
    sites = cluster_hits(hits, 1.5)
    spent = time.process_time() - start
    print(
        f"{hits.n_events / spent:,.0f} events/s merged, "
        f"{len(hits.edep_kev) / hits.n_events:.0f} hits to "
        f"{len(sites.edep_kev) / hits.n_events:.2f} sites per event"
    )


if __name__ == "__main__":
    main()
