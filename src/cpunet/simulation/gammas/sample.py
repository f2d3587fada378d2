"""Hits of the 2614.5 keV gamma line of Tl-208 in a germanium detector.

In the compiled event loop photons from the source are followed until absorbed or lost.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
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
    electron_table,
    photon_table,
)
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.outline import Outline, in_germanium

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
    outline: Outline,
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
    length = outline.crystal_length
    while n_stack > 0:
        n_stack -= 1
        x, y, z = stack[n_stack, 0], stack[n_stack, 1], stack[n_stack, 2]
        direction = UnitVector(stack[n_stack, 3], stack[n_stack, 4], stack[n_stack, 5])
        energy = stack[n_stack, 6]
        while True:
            if energy < PHOTON_CUT:
                if in_germanium(outline, x, y, z):
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
            if not 0.0 <= z <= length or x * x + y * y > outline.crystal_radius**2:
                break
            if not in_germanium(outline, x, y, z):
                continue
            chance = rng.random()
            if chance < photons.photoelectric[node]:
                bound = K_BINDING if energy > K_BINDING else energy
                n_hits = record(hits, n_hits, x, y, z, bound)
                kinetic = energy - bound
                away = forward(direction, kinetic, rng)
                n_hits, n_stack = slow_down(
                    outline, electrons, (x, y, z), away, kinetic, electron,
                    hits, n_hits, stack, n_stack, rng,
                )  # fmt: skip
                break
            if chance < photons.not_pair[node]:
                left_over = compton_energy(energy, rng)
                cosine = 1.0 - ELECTRON_MASS * (1.0 / left_over - 1.0 / energy)
                scattered = turned(direction, cosine, 2.0 * math.pi * rng.random())
                recoil = remainder(energy, direction, left_over, scattered)
                n_hits, n_stack = slow_down(
                    outline, electrons, (x, y, z), recoil, energy - left_over, electron,
                    hits, n_hits, stack, n_stack, rng,
                )  # fmt: skip
                energy, direction = left_over, scattered
                continue
            kinetic = energy - 2.0 * ELECTRON_MASS
            mine = pair_share(rng) * kinetic
            for positron in (False, True):
                part = kinetic - mine if positron else mine
                away = forward(direction, part, rng)
                n_hits, n_stack = slow_down(
                    outline, electrons, (x, y, z), away, part, positron,
                    hits, n_hits, stack, n_stack, rng,
                )  # fmt: skip
            break
    return n_hits


@kernel(error_model="numpy")
def way_to_cylinder(
    outline: Outline, x: float, y: float, z: float, direction: UnitVector
) -> float:
    """Distance in mm from a point above the crystal to its enclosing cylinder; -1 if missed."""
    radius, length = outline.crystal_radius, outline.crystal_length
    u, v, w = direction
    if w >= 0.0:
        return -1.0
    t = (length - z) / w
    if (x + t * u) ** 2 + (y + t * v) ** 2 <= radius**2:
        return t
    a = u * u + v * v
    b = x * u + y * v
    c = x * x + y * y - radius**2
    inside_root = b * b - a * c
    if a == 0.0 or inside_root <= 0.0:
        return -1.0
    t = (-b - math.sqrt(inside_root)) / a
    height = z + t * w
    return t if t > 0.0 and 0.0 <= height <= length else -1.0


@kernel(error_model="numpy")
def emit(outline: Outline, source: SourceDisc, stack: Array, rng: np.random.Generator) -> int:
    """Place a photon where it meets the cylinder of the crystal; return 0 if it misses."""
    r = source.radius * math.sqrt(rng.random())
    around = 2.0 * math.pi * rng.random()
    x, y, z = r * math.cos(around), r * math.sin(around), outline.crystal_length + source.height
    cosine = source.least_cosine + (1.0 - source.least_cosine) * rng.random()
    down = turned(UnitVector(0.0, 0.0, -1.0), cosine, 2.0 * math.pi * rng.random())
    way = way_to_cylinder(outline, x, y, z, down)
    if way < 0.0:
        return 0
    # rounding must not leave it just outside, where it would count as lost
    way += 1e-9
    return put_photon(
        stack, 0, x + way * down.x, y + way * down.y, z + way * down.z, down, source.energy
    )


@kernel(error_model="numpy")
def simulate_block(
    outline: Outline,
    source: SourceDisc,
    photons: PhotonTable,
    electrons: ElectronTable,
    n_primaries: int,
    low: Array,
    high: Array,
    wanted: Integers,
    rng: np.random.Generator,
    hits: Array,
    offsets: Integers,
    primaries: Integers,
) -> tuple[int, int]:
    """Simulate until the primaries, the space for hits or the requested events run out.

    Energies are in MeV. An event is kept if it lies in a window (low to high) that still
    needs events, or always if there are no windows. `wanted` is counted down. Returns the
    numbers of primaries done and of events kept.
    """
    stack = np.empty((STACK_HEIGHT, 7))
    n_kept = 0
    offsets[0] = 0
    for primary in range(n_primaries):
        start = offsets[n_kept]
        full = len(hits) - start < MAX_HITS or n_kept == len(primaries)
        if full or (len(wanted) > 0 and wanted.sum() == 0):
            return primary, n_kept
        n_stack = emit(outline, source, stack, rng)
        if n_stack == 0:
            continue
        mine = hits[start : start + MAX_HITS]
        n_hits = follow_photons(outline, photons, electrons, mine, stack, n_stack, rng)
        energy = 0.0
        for i in range(n_hits):
            energy += mine[i, 3]
        if energy == 0.0:
            continue
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


TL208_KEV = 2614.511
"""Energy of the gamma line of Tl-208 in keV."""

_BLOCK_HITS = 1_000_000
_BLOCK_EVENTS = 20_000


class EnergyWindow(NamedTuple):
    """Energies (keV) from `low_kev` to `high_kev`, both included, under a name."""

    name: str
    low_kev: float
    high_kev: float


def simulate_gammas(
    detector: Detector,
    *,
    source_height_mm: float,
    source_radius_mm: float,
    n_primaries: int,
    seed: int,
    wanted: Mapping[EnergyWindow, int] = MappingProxyType({}),
    energy_kev: float = TL208_KEV,
) -> tuple[Hits, int]:
    r"""Simulate gammas from a disc above the crystal, in vacuum.

    Gammas are emitted isotropically into the cone around the axis that is as wide as crystal
    and disc together,

    .. math:: \cos\theta > \frac{h}{\sqrt{h^2 + (R + r)^2}},

    so that the simulated fraction of the full solid angle is :math:`(1 - \cos\theta)/2` at
    the limit. Photons undergo Compton scattering (Klein-Nishina with the cross section of
    bound electrons), photoelectric absorption and pair production. Electrons and positrons
    slow down continuously, scatter and radiate. Positrons annihilate at rest or in flight.

    Parameters
    ----------
    detector
        The crystal. Its lithium layer is treated as germanium.
    source_height_mm, source_radius_mm
        Height of the disc above the top of the crystal (z = crystal length) and its radius,
        in mm.
    n_primaries
        Number of gammas in the cone; with `wanted`, the maximum number.
    seed
        Seed of the random generator. The same seed gives the same events.
    wanted
        Number of events requested in each energy window. Only events in a window are kept,
        until each has its number.
    energy_kev
        Energy of the gammas, 50 to 2700 keV.

    Returns
    -------
    Hits
        Events with a deposit. ``event_number`` is the number of the primary.
    int
        Number of gammas in the cone, including those of events that were not kept.

    Raises
    ------
    CpunetError
        If a window is empty or beyond the line, or `n_primaries` gammas do not yield the
        requested events.
    """
    for line in wanted:
        if not line.low_kev < line.high_kev or line.low_kev > energy_kev:
            raise CpunetError(
                f"{line.name}: window {line.low_kev} to {line.high_kev} keV holds no event of "
                f"the {energy_kev} keV line; give another"
            )
    outline = Outline.of(detector)
    reach = outline.crystal_radius + source_radius_mm
    cosine = source_height_mm / math.hypot(source_height_mm, reach)
    source = SourceDisc(
        energy_kev / 1e3, float(source_height_mm), float(source_radius_mm), cosine
    )
    # the sum of deposits equals the energy of the line only up to rounding
    low = np.array([line.low_kev / 1e3 - 1e-9 for line in wanted])
    high = np.array([line.high_kev / 1e3 + 1e-9 for line in wanted])
    missing = np.array(list(wanted.values()), np.int64)
    rng = np.random.default_rng(seed)
    hits = np.empty((min(_BLOCK_HITS, MAX_HITS + 300 * n_primaries), 4))
    offsets = np.zeros(_BLOCK_EVENTS + 1, np.int64)
    primaries = np.empty(_BLOCK_EVENTS, np.int64)
    blocks: list[Hits] = [Hits.of([], [], [0])]
    done = 0
    while done < n_primaries and not (wanted and missing.sum() == 0):
        tried, kept = simulate_block(
            outline, source, photon_table(), electron_table(), n_primaries - done,
            low, high, missing, rng, hits, offsets, primaries,
        )  # fmt: skip
        ends = offsets[: kept + 1].copy()
        deposits = hits[: ends[-1]]
        blocks.append(
            Hits.of(deposits[:, :3], deposits[:, 3] * 1e3, ends, primaries[:kept] + done)
        )
        done += tried
    if missing.any():
        short = ", ".join(f"{n} of {w.name}" for w, n in zip(wanted, missing, strict=True) if n)
        raise CpunetError(f"{n_primaries} gammas were not enough: {short} missing; allow more")
    return Hits.concatenate(blocks), done
