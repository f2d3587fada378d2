"""Built-in gamma transport on one core: gammas, double-escape events and sites per second.

Run with ``python benchmarks/gammas.py``; takes about a minute.  The shares of the lines are
compared with those of Geant4 11.4 (option0) for the same crystal and sources.
"""

from __future__ import annotations

import functools
import time

import numpy as np

from cpunet.simulation.gammas import EnergyWindow, simulate_gammas
from cpunet.simulation.geometry import Detector
from cpunet.simulation.simulator import merge_hits

N_EVENTS = 3_000
DEP = {EnergyWindow("DEP", 1591.0, 1594.0): N_EVENTS}
# fractions of the gammas in the cone to the crystal: any hit; within 1 keV of FEP, SEP and DEP
GEANT4 = {20.0: (0.4265, 0.0997, 0.01131, 0.00370), 100.0: (0.4450, 0.1101, 0.01199, 0.00386)}
LINES_KEV = (2614.511, 2103.511, 1592.511)


CRYSTAL = Detector(
    crystal_length=96.0,
    crystal_radius=40.5,
    bore_length=69.9,
    bore_radius=5.0,
    # the rest does not matter to gammas
    point_contact_length=2.0,
    point_contact_radius=2.3,
    li_thickness=1.0,
    impurity_z0_1e10_per_cm3=-1.8,
    bias_V=4000.0,
    temperature_K=90.0,
)


def main() -> None:
    source = functools.partial(
        simulate_gammas, CRYSTAL, source_height_mm=20.0, source_radius_mm=5.0, seed=1
    )
    source(n_primaries=10)  # compile
    start = time.process_time()
    hits, gammas = source(n_primaries=10_000_000, wanted=DEP)
    spent = time.process_time() - start
    print(f"{gammas / spent:,.0f} gammas/s, {N_EVENTS / spent:,.0f} DEP events/s")
    merge_hits(hits[:10], 1.5)
    start = time.process_time()
    sites = merge_hits(hits, 1.5)
    spent = time.process_time() - start
    print(
        f"{len(hits) / spent:,.0f} events/s merged, "
        f"{len(hits.edep_kev) / len(hits):.0f} hits to "
        f"{len(sites.edep_kev) / len(hits):.2f} sites per event"
    )
    for height_mm, expected in GEANT4.items():
        compare(height_mm, expected)


def compare(height_mm: float, expected: tuple[float, ...]) -> None:
    counts, gammas, hit = np.zeros(len(LINES_KEV)), 0, 0
    for seed in range(4):
        hits, n_primaries = simulate_gammas(
            CRYSTAL,
            source_height_mm=height_mm,
            source_radius_mm=5.0,
            n_primaries=1_000_000,
            seed=seed,
        )
        gammas += n_primaries
        hit += len(hits)
        kev = hits.energy_kev
        counts += [(np.abs(kev - line) < 1).sum() for line in LINES_KEV]
    print(f"source {height_mm:.0f} mm above, of Geant4's: hit", end=" ")
    print(f"{hit / gammas / expected[0]:.3f}", end="")
    for line, n, share in zip(LINES_KEV, counts, expected[1:], strict=True):
        ratio = n / gammas / share
        print(f", {line:.0f} keV {ratio:.3f} ± {ratio / n**0.5:.3f}", end="")
    print()


if __name__ == "__main__":
    main()
