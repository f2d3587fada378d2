"""Do the events of both sides of a stand differ? Compares their hits, before any pulse.

    python benchmarks/stand_populations.py --seeds 21-23
    python benchmarks/stand_populations.py --seeds 100-123

The sides of a stand are drawn independently, so they differ by chance, which shifts the result
of a calibration. Prints, for each seed and for all together, by how many standard errors the
means of the events of the full-energy peak differ.
"""

from __future__ import annotations

import argparse

import numpy as np
import numpy.typing as npt

from cpunet.electronics.stand import Side
from cpunet.simulation.gammas import EnergyWindow
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import Shift, SimulationSettings
from cpunet.simulation.simulate import GammaSource
from cpunet.simulation.simulator import merge_hits

FEP = EnergyWindow("FEP", 2609.511, 2619.511)
NAMES = ("radius", "height", "spread in r", "spread in z", "sites", "largest site's share")
SITE_MM, LOST_KEV = 1.0, 0.5
Values = npt.NDArray[np.float64]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="100-123", help="first-last")
    parser.add_argument("--events", type=int, default=3000)
    arguments = parser.parse_args()
    first, last = map(int, arguments.seeds.split("-"))
    print("seed", *NAMES, sep=" | ")
    sides: list[list[Values]] = [[], []]
    for seed in range(first, last + 1):
        seeds = np.random.SeedSequence(seed).generate_state(3, np.uint32).tolist()
        here = []
        for shift, side_seed in zip((Shift(), Shift.of(["default"])), seeds, strict=False):
            physics = shift.applied(SimulationSettings())
            source = physics.source_height_mm, physics.source_radius_mm, side_seed
            events = GammaSource({FEP: arguments.events}, *source)
            here.append(events_of(Side(shift.applied(read_detector("icpc")), physics, events)))
        for all_of_side, these in zip(sides, here, strict=True):
            all_of_side.append(these)
        print(seed, *deviations(*here), sep=" | ", flush=True)
    print("all", *deviations(*map(np.concatenate, sides)), sep=" | ")


def events_of(side: Side) -> Values:
    """`NAMES` of each event with all its energy in active germanium, shape (events, 6)."""
    blocks = []
    for hits in side.source.open(side.detector).blocks:
        active = side.detector.active(np.hypot(hits.x_mm, hits.y_mm), hits.z_mm)
        lost = np.add.reduceat(hits.edep_kev * ~active, hits.offsets[:-1])
        sites = merge_hits(hits[lost < LOST_KEV], SITE_MM)
        begin, energy = sites.offsets[:-1], sites.edep_kev
        radius = np.hypot(sites.x_mm, sites.y_mm)
        total = np.add.reduceat(energy, begin)
        means = [
            np.add.reduceat(energy * values, begin) / total
            for values in (radius, sites.z_mm, radius**2, sites.z_mm**2)
        ]
        spreads = [
            np.sqrt(np.maximum(square - mean**2, 0))
            for mean, square in zip(means[:2], means[2:], strict=True)
        ]
        largest = np.maximum.reduceat(energy, begin) / total
        blocks.append(np.stack([*means[:2], *spreads, np.diff(sites.offsets), largest], 1))
    return np.concatenate(blocks)


def deviations(sim: Values, data: Values) -> list[str]:
    """Differences of the means in standard errors."""
    error = np.sqrt(sim.var(axis=0) / len(sim) + data.var(axis=0) / len(data))
    return [f"{z:+.1f}" for z in (sim.mean(axis=0) - data.mean(axis=0)) / error]


if __name__ == "__main__":
    main()
