"""Hits of the 2614.5 keV gamma line of Tl-208 in a germanium detector.

In the compiled event loop photons from the source are followed until absorbed or lost.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.kernels import kernel
from cpunet.simulation.gammas.electrons import (
    ELECTRON_MASS,
    HITS,
    K_BINDING,
    LOST,
    PHOTON_CUT,
    PHOTONS,
    Array,
    ElectronTable,
    Event,
    PhotonTable,
    UnitVector,
    compton_energy,
    electron_table,
    forward,
    pair_share,
    photon_table,
    put_photon,
    record,
    remainder,
    slow_down,
    turned,
)
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.outline import Outline, in_germanium, outline_of

log = logging.getLogger(__name__)

Integers = npt.NDArray[np.int64]

MAX_HITS, MAX_PHOTONS = 2000, 256
"""Maximum numbers of hits and of photons per event; Tl-208 gives about 200 hits."""


class Medium(NamedTuple):
    """A crystal with its lithium layer, and tables of photons and electrons in germanium."""

    outline: Outline
    photons: PhotonTable
    electrons: ElectronTable


@kernel(error_model="numpy")
def follow_photons(medium: Medium, event: Event, rng: np.random.Generator) -> None:
    """Follow all photons of an event, and all that these make.

    The path to the next interaction is drawn as if germanium filled all space. If it ends in
    vacuum, nothing happens and the photon continues (Woodcock's method), so any outline is
    possible. A photon that leaves the cylinder around the crystal does not return.
    """
    outline, photons, electrons = medium
    electron = bool(np.bool_(False))  # numba compiles a function anew for each constant
    while event.counts[PHOTONS] > 0:
        event.counts[PHOTONS] -= 1
        row = event.photons[event.counts[PHOTONS]]
        x, y, z, energy = row[0], row[1], row[2], row[6]
        direction = UnitVector(row[3], row[4], row[5])
        while True:
            if energy < PHOTON_CUT:
                if in_germanium(outline, x, y, z, 0.0):
                    record(event, x, y, z, energy)
                break
            at = (math.log(energy) - photons.log_first) * photons.per_log
            node = int(at)
            left = photons.attenuation_per_mm[node]
            attenuation = left + (at - node) * (photons.attenuation_per_mm[node + 1] - left)
            path = -math.log(1.0 - rng.random()) / attenuation
            x, y, z = x + path * direction.x, y + path * direction.y, z + path * direction.z
            if (
                not 0.0 <= z <= outline.crystal_length
                or x * x + y * y > outline.crystal_radius**2
            ):
                break
            if not in_germanium(outline, x, y, z, 0.0):
                continue
            place, chance = (x, y, z), rng.random()
            if chance < photons.photoelectric[node]:
                kinetic = energy - min(energy, K_BINDING)
                record(event, x, y, z, min(energy, K_BINDING))
                away = forward(direction, kinetic, rng)
                slow_down(outline, electrons, event, place, away, kinetic, electron, rng)
                break
            if chance < photons.not_pair[node]:
                left_over = compton_energy(energy, rng)
                cosine = 1.0 - ELECTRON_MASS * (1.0 / left_over - 1.0 / energy)
                scattered = turned(direction, cosine, 2.0 * math.pi * rng.random())
                recoil = remainder(energy, direction, left_over, scattered)
                kinetic = energy - left_over
                slow_down(outline, electrons, event, place, recoil, kinetic, electron, rng)
                energy, direction = left_over, scattered
                continue
            kinetic = energy - 2.0 * ELECTRON_MASS
            of_electron = pair_share(rng) * kinetic
            for positron in (False, True):
                part = kinetic - of_electron if positron else of_electron
                away = forward(direction, part, rng)
                slow_down(outline, electrons, event, place, away, part, positron, rng)
            break


@kernel(error_model="numpy")
def emit(
    outline: Outline,
    source: tuple[float, float, float, float],
    event: Event,
    rng: np.random.Generator,
) -> None:
    """Place a photon where it meets the cylinder around the crystal; none if it misses.

    The source is a disc above the crystal that emits into a cone about the axis: energy (MeV),
    height above the crystal and radius (mm), and cosine of the cone's half angle.
    """
    energy, height, disc, least_cosine = source
    radius, length = outline.crystal_radius, outline.crystal_length
    r = disc * math.sqrt(rng.random())
    around = 2.0 * math.pi * rng.random()
    x, y, z = r * math.cos(around), r * math.sin(around), length + height
    cosine = least_cosine + (1.0 - least_cosine) * rng.random()
    down = turned(UnitVector(0.0, 0.0, -1.0), cosine, 2.0 * math.pi * rng.random())
    u, v, w = down
    if w >= 0.0:
        return
    way = (length - z) / w
    if (x + way * u) ** 2 + (y + way * v) ** 2 > radius**2:  # not on the top: on the side?
        a = u * u + v * v
        b = x * u + y * v
        c = x * x + y * y - radius**2
        inside_root = b * b - a * c
        if a == 0.0 or inside_root <= 0.0:
            return
        way = (-b - math.sqrt(inside_root)) / a
        if not (way > 0.0 and 0.0 <= z + way * w <= length):
            return
    way += 1e-9  # rounding must not leave it just outside, where it would count as lost
    put_photon(event, x + way * u, y + way * v, z + way * w, down, energy)


@kernel(error_model="numpy")
def simulate_block(
    medium: Medium,
    source: tuple[float, float, float, float],
    n_primaries: int,
    windows: Array,
    missing: Integers,
    rng: np.random.Generator,
    hits: Array,
    offsets: Integers,
    primaries: Integers,
) -> tuple[int, int, int]:
    """Simulate until the primaries, the space for hits or the missing events run out.

    An event counts if it lies in one of the `windows` (low and high in MeV) of which events
    are still `missing`, or always if there are no windows. Returns the numbers of primaries
    done, of events chosen, and of events left out because they have more than `MAX_HITS`
    deposits.
    """
    photons, counts = np.empty((MAX_PHOTONS, 7)), np.zeros(3, np.int64)
    n_kept = n_left_out = 0
    offsets[0] = 0
    for primary in range(n_primaries):
        start = offsets[n_kept]
        full = len(hits) - start < MAX_HITS or n_kept == len(primaries)
        if full or (len(missing) > 0 and missing.sum() == 0):
            return primary, n_kept, n_left_out
        counts[:] = 0
        event = Event(hits[start : start + MAX_HITS], photons, counts)
        emit(medium.outline, source, event, rng)
        follow_photons(medium, event, rng)
        if counts[LOST] > 0:
            n_left_out += 1
            continue
        energy = 0.0
        for i in range(counts[HITS]):
            energy += event.hits[i, 3]
        if energy == 0.0:
            continue
        keep = len(missing) == 0
        for line in range(len(missing)):
            if missing[line] > 0 and windows[line, 0] <= energy <= windows[line, 1]:
                missing[line] -= 1
                keep = True
                break
        if keep:
            primaries[n_kept] = primary
            n_kept += 1
            offsets[n_kept] = start + counts[HITS]
    return n_primaries, n_kept, n_left_out


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
        Number of events requested in each energy window. Only events in a window count,
        until each has its number.
    energy_kev
        Energy of the gammas, 50 to 2700 keV.

    Returns
    -------
    Hits
        Events with a deposit. ``event_number`` is the number of the primary.
    int
        Number of gammas in the cone, including those of events that were not chosen.

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
    medium = Medium(outline_of(detector), photon_table(), electron_table())
    height, radius = float(source_height_mm), float(source_radius_mm)
    cosine = height / math.hypot(height, detector.crystal_radius + radius)
    source = energy_kev / 1e3, height, radius, cosine
    # the sum of deposits equals the energy of the line only up to rounding
    edges = [(line.low_kev / 1e3 - 1e-9, line.high_kev / 1e3 + 1e-9) for line in wanted]
    windows, missing = np.array(edges).reshape(-1, 2), np.array([*wanted.values()], np.int64)
    rng = np.random.default_rng(seed)
    hits = np.empty((min(_BLOCK_HITS, MAX_HITS + 300 * n_primaries), 4))
    offsets = np.zeros(_BLOCK_EVENTS + 1, np.int64)
    primaries = np.empty(_BLOCK_EVENTS, np.int64)
    blocks: list[Hits] = [Hits.of([], [], [0])]
    done = left_out = 0
    while done < n_primaries and not (wanted and missing.sum() == 0):
        tried, n_chosen, large = simulate_block(
            medium, source, n_primaries - done, windows, missing, rng, hits, offsets, primaries
        )
        ends = offsets[: n_chosen + 1].copy()
        deposits = hits[: ends[-1]]
        blocks.append(
            Hits.of(deposits[:, :3], deposits[:, 3] * 1e3, ends, primaries[:n_chosen] + done)
        )
        done, left_out = done + tried, left_out + large
    if left_out:
        log.warning(f"{left_out} events have more than {MAX_HITS} deposits and are left out")
    if missing.any():
        short = ", ".join(f"{n} of {w.name}" for w, n in zip(wanted, missing, strict=True) if n)
        raise CpunetError(f"{n_primaries} gammas were not enough: {short} missing; allow more")
    return Hits.concatenate(blocks), done
