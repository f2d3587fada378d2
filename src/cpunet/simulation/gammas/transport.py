"""Compiled event loop: photons from the source are followed until absorbed or lost."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel
from cpunet.simulation.gammas.electrons import (
    UnitVector,
    compton_energy,
    forward,
    pair_share,
    put_photon,
    record,
    remainder,
    slow_down,
    turned,
)
from cpunet.simulation.gammas.germanium import (
    ELECTRON_MASS,
    K_BINDING,
    PHOTON_CUT,
    Array,
    ElectronTable,
    PhotonTable,
)
from cpunet.simulation.gammas.shape import CrystalShape, in_germanium, way_to_cylinder

Integers = npt.NDArray[np.int64]

STACK_HEIGHT = 256
MAX_HITS = 2000
"""Maximum number of hits per event; Tl-208 gives about 200."""


class SourceDisc(NamedTuple):
    """A disc above the crystal that emits into the cone around the top of the crystal."""

    energy: float
    height: float
    radius: float
    least_cosine: float


@kernel(error_model="numpy")
def follow_photons(
    shape: CrystalShape,
    photons: PhotonTable,
    electrons: ElectronTable,
    hits: Array,
    stack: Array,
    n_stack: int,
    rng: np.random.Generator,
) -> int:
    """Follow all photons on the stack; return the number of hits.

    The path to the next interaction is drawn as if germanium filled all space. If it ends in
    vacuum, nothing happens and the photon continues (Woodcock's method), so any outline is
    possible. A photon that leaves the cylinder around the crystal does not return.
    """
    # numba compiles a function anew for each constant that it is called with
    n_hits, electron = int(np.int64(0)), bool(np.bool_(False))
    while n_stack > 0:
        n_stack -= 1
        x, y, z = stack[n_stack, 0], stack[n_stack, 1], stack[n_stack, 2]
        direction = UnitVector(stack[n_stack, 3], stack[n_stack, 4], stack[n_stack, 5])
        energy = stack[n_stack, 6]
        while True:
            if energy < PHOTON_CUT:
                if in_germanium(shape, x, y, z):
                    n_hits = record(hits, n_hits, x, y, z, energy)
                break
            at = (math.log(energy) - photons.log_first) * photons.per_log
            node = int(at)
            more = at - node
            left = photons.attenuation_per_mm[node]
            attenuation = left + more * (photons.attenuation_per_mm[node + 1] - left)
            path = -math.log(1.0 - rng.random()) / attenuation
            x += path * direction.x
            y += path * direction.y
            z += path * direction.z
            if z < 0.0 or z > shape.length or x * x + y * y > shape.radius**2:
                break
            if not in_germanium(shape, x, y, z):
                continue
            chance = rng.random()
            if chance < photons.photoelectric[node]:
                bound = K_BINDING if energy > K_BINDING else energy
                n_hits = record(hits, n_hits, x, y, z, bound)
                kinetic = energy - bound
                away = forward(direction, kinetic, rng)
                n_hits, n_stack = slow_down(
                    shape, electrons, (x, y, z), away, kinetic, electron,
                    hits, n_hits, stack, n_stack, rng,
                )  # fmt: skip
                break
            if chance < photons.not_pair[node]:
                left_over = compton_energy(energy, rng)
                cosine = 1.0 - ELECTRON_MASS * (1.0 / left_over - 1.0 / energy)
                scattered = turned(direction, cosine, 2.0 * math.pi * rng.random())
                recoil = remainder(energy, direction, left_over, scattered)
                n_hits, n_stack = slow_down(
                    shape, electrons, (x, y, z), recoil, energy - left_over, electron,
                    hits, n_hits, stack, n_stack, rng,
                )  # fmt: skip
                energy, direction = left_over, scattered
                continue
            kinetic = energy - 2.0 * ELECTRON_MASS
            mine = pair_share(rng) * kinetic
            for positron in (False, True):
                part = kinetic - mine if positron else mine
                n_hits, n_stack = slow_down(
                    shape, electrons, (x, y, z), forward(direction, part, rng), part, positron,
                    hits, n_hits, stack, n_stack, rng,
                )  # fmt: skip
            break
    return n_hits


@kernel(error_model="numpy")
def emit(
    shape: CrystalShape, source: SourceDisc, stack: Array, rng: np.random.Generator
) -> int:
    """Place a photon where it meets the cylinder of the crystal; return 0 if it misses."""
    r = source.radius * math.sqrt(rng.random())
    around = 2.0 * math.pi * rng.random()
    x, y, z = r * math.cos(around), r * math.sin(around), shape.length + source.height
    cosine = source.least_cosine + (1.0 - source.least_cosine) * rng.random()
    down = turned(UnitVector(0.0, 0.0, -1.0), cosine, 2.0 * math.pi * rng.random())
    way = way_to_cylinder(shape.radius, shape.length, x, y, z, down.x, down.y, down.z)
    if way < 0.0:
        return 0
    # rounding must not leave it just outside, where it would count as lost
    way += 1e-9
    return put_photon(
        stack, 0, x + way * down.x, y + way * down.y, z + way * down.z, down, source.energy
    )


@kernel(error_model="numpy")
def simulate_block(
    shape: CrystalShape,
    source: SourceDisc,
    photons: PhotonTable,
    electrons: ElectronTable,
    n_primaries: int,
    low: Array,
    high: Array,
    wanted: Integers,
    spectrum: Integers,
    rng: np.random.Generator,
    hits: Array,
    offsets: Integers,
    primaries: Integers,
) -> tuple[int, int]:
    """Simulate until the primaries, the space for hits or the requested events run out.

    Energies are in MeV. An event is kept if it lies in a window (low to high) that still
    needs events, or always if there are no windows. `wanted` is counted down. `spectrum`
    (1 keV bins) counts every event with a deposit. Returns the numbers of primaries done and
    of events kept.
    """
    stack = np.empty((STACK_HEIGHT, 7))
    n_kept = 0
    offsets[0] = 0
    for primary in range(n_primaries):
        start = offsets[n_kept]
        full = len(hits) - start < MAX_HITS or n_kept == len(primaries)
        if full or (len(wanted) > 0 and wanted.sum() == 0):
            return primary, n_kept
        n_stack = emit(shape, source, stack, rng)
        if n_stack == 0:
            continue
        mine = hits[start : start + MAX_HITS]
        n_hits = follow_photons(shape, photons, electrons, mine, stack, n_stack, rng)
        energy = 0.0
        for i in range(n_hits):
            energy += mine[i, 3]
        if energy == 0.0:
            continue
        spectrum[min(int(energy * 1e3), len(spectrum) - 1)] += 1
        keep = len(wanted) == 0
        for line in range(len(wanted)):
            if wanted[line] > 0 and low[line] <= energy <= high[line]:
                wanted[line] -= 1
                keep = True
                break
        if keep:
            primaries[n_kept] = primary
            n_kept += 1
            offsets[n_kept] = start + n_hits
    return n_primaries, n_kept
