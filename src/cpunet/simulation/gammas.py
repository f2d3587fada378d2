"""Monte Carlo of the 2614.5 keV gamma line of Tl-208, for users without Geant4 hits.

In the compiled event loop photons from the source are followed until absorbed or lost, and
electrons and positrons slow down in tabulated steps (`gamma_tables.py`). Energies are in MeV,
directions are unit vectors.

Sources: Compton scattering, Klein and Nishina, sampled as in Nelson et al., SLAC-265 (1985),
§ 2.9; annihilation in flight, Heitler, The Quantum Theory of Radiation (1954), § 27.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cpunet.errors import CpunetError
from cpunet.kernels import kernel
from cpunet.simulation.gamma_tables import (
    ELECTRON_CUT,
    ELECTRON_MASS,
    LOG_RATIO,
    LOG_TOP,
    PHOTON_CUT,
    ElectronTable,
    PhotonTable,
    electron_table,
    photon_table,
)
from cpunet.simulation.geometry import Detector, FloatArray, IntArray
from cpunet.simulation.hits import Hits
from cpunet.simulation.outline import Outline, in_germanium, outline_of

log = logging.getLogger(__name__)

# maximum numbers of hits and of photons per event; Tl-208 gives about 200 hits
MAX_HITS, MAX_PHOTONS = 2000, 256
TL208_KEV = 2614.511
K_BINDING = 0.0111031  # of the K shell, MeV


class UnitVector(NamedTuple):
    """A unit vector."""

    x: float
    y: float
    z: float


@kernel(error_model="numpy")
def turned(axis: UnitVector, cosine: float, azimuth: float) -> UnitVector:
    """Direction at a polar angle and an azimuth (rad) relative to an axis."""
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    a, b = sine * math.cos(azimuth), sine * math.sin(azimuth)
    across = math.sqrt(axis.x * axis.x + axis.y * axis.y)
    if across < 1e-9:
        return UnitVector(a, b, cosine if axis.z > 0 else -cosine)
    return UnitVector(
        (a * axis.x * axis.z - b * axis.y) / across + axis.x * cosine,
        (a * axis.y * axis.z + b * axis.x) / across + axis.y * cosine,
        -a * across + axis.z * cosine,
    )


@kernel(error_model="numpy")
def forward(axis: UnitVector, kinetic: float, rng: np.random.Generator) -> UnitVector:
    """Draw a direction that is isotropic in the rest frame of an electron along the axis.

    This is a common approximation of the angles of photoelectrons, pairs and bremsstrahlung.
    Multiple scattering randomises them within a fraction of the range.
    """
    gamma = 1.0 + kinetic / ELECTRON_MASS
    beta = math.sqrt(max(1.0 - 1.0 / (gamma * gamma), 0.0))
    at_rest = 2.0 * rng.random() - 1.0
    cosine = (at_rest + beta) / (at_rest * beta + 1.0)
    return turned(axis, cosine, 2.0 * math.pi * rng.random())


@kernel(error_model="numpy")
def remainder(total: float, axis: UnitVector, part: float, direction: UnitVector) -> UnitVector:
    """Direction of the remaining momentum after a part is removed from one along `axis`."""
    x = total * axis.x - part * direction.x
    y = total * axis.y - part * direction.y
    z = total * axis.z - part * direction.z
    size = math.sqrt(x * x + y * y + z * z)
    if size == 0.0:
        return axis
    return UnitVector(x / size, y / size, z / size)


@kernel(error_model="numpy")
def compton_energy(energy: float, rng: np.random.Generator) -> float:
    r"""Energy of a photon after Compton scattering on a free electron at rest.

    The energy fraction :math:`\epsilon` follows Klein and Nishina,

    .. math:: p(\epsilon) \propto \frac{1}{\epsilon} + \epsilon - \sin^2\theta, \qquad
        1 - \cos\theta = \frac{m_e c^2}{E} \Big(\frac{1}{\epsilon} - 1\Big).
    """
    k = energy / ELECTRON_MASS
    least = 1.0 / (1.0 + 2.0 * k)
    inverse_part = -math.log(least)
    linear_part = 0.5 * (1.0 - least * least)
    while True:
        if rng.random() * (inverse_part + linear_part) < inverse_part:
            share = math.exp(math.log(least) * rng.random())
        else:
            share = math.sqrt(least * least + (1.0 - least * least) * rng.random())
        t = (1.0 - share) / (k * share)
        sine2 = t * (2.0 - t)
        if rng.random() < 1.0 - share * sine2 / (1.0 + share * share):
            return energy * share


@kernel(error_model="numpy")
def annihilation_energy(kinetic: float, rng: np.random.Generator) -> tuple[float, float]:
    """Energy of one of the two photons, and the cosine of its angle to the positron."""
    gamma = 1.0 + kinetic / ELECTRON_MASS
    half_width = 0.5 * math.sqrt((gamma - 1.0) / (gamma + 1.0))
    least, most = 0.5 - half_width, 0.5 + half_width
    while True:
        share = least * (most / least) ** rng.random()
        weight = 1.0 - share + (2.0 * gamma * share - 1.0) / (share * (gamma + 1.0) ** 2)
        if rng.random() < weight:
            break
    cosine = (share * (gamma + 1.0) - 1.0) / (share * math.sqrt(gamma * gamma - 1.0))
    energy = share * (kinetic + 2.0 * ELECTRON_MASS)
    return energy, min(max(cosine, -1.0), 1.0)


# Entries of `Event.counts`.
HITS, PHOTONS, LOST = range(3)


class Event(NamedTuple):
    """An event as it develops.

    ``hits`` has a row x, y, z (mm), energy (MeV) per deposit, ``photons`` a row x, y, z,
    direction, energy per photon still to be followed. ``counts`` are the numbers of both, and
    of deposits and photons for which there was no room.
    """

    hits: FloatArray
    photons: FloatArray
    counts: IntArray


@kernel(error_model="numpy")
def record(event: Event, x: float, y: float, z: float, energy: float) -> None:
    """Append a deposit (mm, MeV)."""
    n = event.counts[HITS]
    if energy > 0.0 and n < len(event.hits):
        event.hits[n, :] = (x, y, z, energy)
        event.counts[HITS] = n + 1
    elif energy > 0.0:
        event.counts[LOST] += 1


@kernel(error_model="numpy")
def put_photon(
    event: Event, x: float, y: float, z: float, direction: UnitVector, energy: float
) -> None:
    """Append a photon to those still to be followed."""
    n = event.counts[PHOTONS]
    if n == len(event.photons):
        event.counts[LOST] += 1
        return
    event.photons[n, :] = (x, y, z, direction.x, direction.y, direction.z, energy)
    event.counts[PHOTONS] = n + 1


@kernel(error_model="numpy")
def slow_down(
    outline: Outline,
    table: ElectronTable,
    event: Event,
    position: tuple[float, float, float],
    direction: UnitVector,
    kinetic: float,
    positron: bool,
    rng: np.random.Generator,
) -> None:
    """Follow an electron until it stops or escapes, with its deposits and photons.

    Each step runs straight to a random hinge, deposits its energy there, turns and runs
    straight to its end (Baró et al., NIM B 100 (1995) 31). Mean and spread of the
    displacement are therefore correct despite the long steps.
    """
    x, y, z = position
    row, part, within_step = -1, 1.0, True
    while kinetic > ELECTRON_CUT:
        row, part = row + 1, 1.0
        if within_step:  # the step that holds this energy, from its upper end downwards
            row = int((math.log(kinetic) - LOG_TOP) / LOG_RATIO)
            row = min(max(row, 0), len(table.energy) - 2)
            after = table.energy[row + 1]
            part = (kinetic - after) / (table.energy[row] - after)
        within_step = False
        length = part * table.step[row]
        hinge = length * rng.random()
        x, y, z = x + hinge * direction.x, y + hinge * direction.y, z + hinge * direction.z
        if not in_germanium(outline, x, y, z, 0.0):
            return
        record(event, x, y, z, kinetic - table.energy[row + 1])
        kinetic = table.energy[row + 1]
        scale = table.scattering[row] * part
        cosine = 1.0 + scale * math.log(1.0 - rng.random() * table.scattering_cut[row])
        direction = turned(direction, cosine, 2.0 * math.pi * rng.random())
        length -= hinge
        x, y, z = x + length * direction.x, y + length * direction.y, z + length * direction.z
        if not in_germanium(outline, x, y, z, 0.0):
            return
        chance = rng.random()
        if chance < part * table.brems[row]:
            shares = table.photon_share[row]
            at = rng.random() * (len(shares) - 1)
            low, high = shares[int(at)], shares[int(at) + 1]
            photon = min(low + (at - int(at)) * (high - low), 1.0) * kinetic
            put_photon(event, x, y, z, forward(direction, kinetic, rng), photon)
            kinetic, within_step = kinetic - photon, True
        elif positron and 1.0 - chance < part * table.annihilation[row]:
            momentum = math.sqrt(kinetic * (kinetic + 2.0 * ELECTRON_MASS))
            energy, cosine = annihilation_energy(kinetic, rng)
            first = turned(direction, cosine, 2.0 * math.pi * rng.random())
            put_photon(event, x, y, z, first, energy)
            second = remainder(momentum, direction, energy, first)
            put_photon(event, x, y, z, second, kinetic + 2.0 * ELECTRON_MASS - energy)
            return
    record(event, x, y, z, kinetic)
    if positron:
        cosine, up = 2.0 * rng.random() - 1.0, UnitVector(0.0, 0.0, 1.0)
        first = turned(up, cosine, 2.0 * math.pi * rng.random())
        put_photon(event, x, y, z, first, ELECTRON_MASS)
        second = UnitVector(-first.x, -first.y, -first.z)
        put_photon(event, x, y, z, second, ELECTRON_MASS)


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
            low, high = photons.attenuation_per_mm[node], photons.attenuation_per_mm[node + 1]
            path = -math.log(1.0 - rng.random()) / (low + (at - node) * (high - low))
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
                part = energy - left_over
                slow_down(outline, electrons, event, place, recoil, part, electron, rng)
                energy, direction = left_over, scattered
                continue
            # of a pair's kinetic energy: p+ p-, the phase space at threshold
            kinetic, share = energy - 2.0 * ELECTRON_MASS, rng.random()
            while rng.random() >= 2.0 * math.sqrt(share * (1.0 - share)):
                share = rng.random()
            for positron in (False, True):
                part = kinetic - share * kinetic if positron else share * kinetic
                away = forward(direction, part, rng)
                slow_down(outline, electrons, event, place, away, part, positron, rng)
            break


# energy (MeV), height above the crystal and radius (mm), and cosine of a cone's half angle
Source = tuple[float, float, float, float]


@kernel(error_model="numpy")
def emit(outline: Outline, source: Source, event: Event, rng: np.random.Generator) -> None:
    """Place a photon where it meets the cylinder around the crystal; none if it misses.

    The source is a disc above the crystal that emits into a cone about the axis.
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
def simulate_events(
    medium: Medium,
    source: Source,
    n_primaries: int,
    windows: FloatArray,
    missing: IntArray,
    rng: np.random.Generator,
) -> tuple[FloatArray, IntArray, int, int]:
    """Simulate until the primaries or the missing events run out.

    An event counts if it lies in one of the `windows` (low and high in MeV) of which events
    are still `missing`, or always if there are no windows. Returns the deposits, the primary
    and the end of each event, and the numbers of primaries, and of events left out because they
    have more than `MAX_HITS` deposits.
    """
    photons, counts = np.empty((MAX_PHOTONS, 7)), np.zeros(3, np.int64)
    hits, events = np.empty((2 * MAX_HITS, 4)), np.empty((64, 2), np.int64)  # they grow
    end = n_events = n_left_out = 0
    for primary in range(n_primaries):
        if len(missing) > 0 and missing.sum() == 0:
            n_primaries = primary
            break
        if len(hits) - end < MAX_HITS:
            hits = np.concatenate((hits, np.empty_like(hits)))
        if n_events == len(events):
            events = np.concatenate((events, np.empty_like(events)))
        counts[:] = 0
        event = Event(hits[end : end + MAX_HITS], photons, counts)
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
            end += counts[HITS]
            events[n_events, :] = (primary, end)
            n_events += 1
    return hits[:end], events[:n_events], n_primaries, n_left_out


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
        if not line.low_kev < line.high_kev or line.low_kev > TL208_KEV:
            raise CpunetError(
                f"{line.name}: window {line.low_kev} to {line.high_kev} keV holds no event of "
                f"the {TL208_KEV} keV line; give another"
            )
    medium = Medium(outline_of(detector), photon_table(), electron_table())
    height, radius = float(source_height_mm), float(source_radius_mm)
    cosine = height / math.hypot(height, detector.crystal_radius + radius)
    source = TL208_KEV / 1e3, height, radius, cosine
    # the sum of deposits equals the energy of the line only up to rounding
    edges = [(line.low_kev / 1e3 - 1e-9, line.high_kev / 1e3 + 1e-9) for line in wanted]
    windows, missing = np.array(edges).reshape(-1, 2), np.array([*wanted.values()], np.int64)
    rng = np.random.default_rng(seed)
    deposits, events, done, left_out = simulate_events(
        medium, source, n_primaries, windows, missing, rng
    )
    if left_out:
        log.warning(f"{left_out} events have more than {MAX_HITS} deposits and are left out")
    if missing.any():
        short = ", ".join(f"{n} of {w.name}" for w, n in zip(wanted, missing, strict=True) if n)
        raise CpunetError(f"{n_primaries} gammas were not enough: {short} missing; allow more")
    offsets = np.append(0, events[:, 1])
    return Hits.of(deposits[:, :3], deposits[:, 3] * 1e3, offsets, events[:, 0]), done
