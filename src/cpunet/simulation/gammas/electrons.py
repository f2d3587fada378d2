"""Slowing down of electrons and positrons in tabulated steps, and single interactions.

Energies are in MeV, directions are unit vectors. Compton: Klein and Nishina, sampled as in
Nelson et al., SLAC-265 (1985), § 2.9. Annihilation in flight: Heitler's cross section.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel
from cpunet.simulation.gammas.germanium import ELECTRON_CUT, ELECTRON_MASS, Array, ElectronTable
from cpunet.simulation.outline import Outline, in_germanium


class UnitVector(NamedTuple):
    """A unit vector."""

    x: float
    y: float
    z: float


@kernel(error_model="numpy")
def isotropic(rng: np.random.Generator) -> UnitVector:
    """Draw an isotropic direction."""
    cosine = 2.0 * rng.random() - 1.0
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    azimuth = 2.0 * math.pi * rng.random()
    return UnitVector(sine * math.cos(azimuth), sine * math.sin(azimuth), cosine)


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
def pair_share(rng: np.random.Generator) -> float:
    """Electron's fraction of a pair's kinetic energy: p+ p-, the phase space at threshold."""
    while True:
        share = rng.random()
        if rng.random() < 2.0 * math.sqrt(share * (1.0 - share)):
            return share


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

    hits: Array
    photons: Array
    counts: npt.NDArray[np.int64]


@kernel(error_model="numpy")
def record(event: Event, x: float, y: float, z: float, energy: float) -> None:
    """Append a deposit (mm, MeV)."""
    n = event.counts[HITS]
    if energy > 0.0 and n < len(event.hits):
        row = event.hits[n]
        row[0], row[1], row[2], row[3] = x, y, z, energy
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
    row = event.photons[n]
    row[0], row[1], row[2] = x, y, z
    row[3], row[4], row[5] = direction.x, direction.y, direction.z
    row[6] = energy
    event.counts[PHOTONS] = n + 1


@kernel(error_model="numpy")
def row_of(table: ElectronTable, kinetic: float) -> int:
    """Index of the step that contains an energy (MeV), from its upper end downwards."""
    if kinetic <= ELECTRON_CUT:
        return 0
    row = int((math.log(kinetic) - table.log_top) / table.log_ratio)
    return min(max(row, 0), len(table.energy) - 2)


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
    row = row_of(table, kinetic)
    part = (kinetic - table.energy[row + 1]) / (table.energy[row] - table.energy[row + 1])
    while kinetic > ELECTRON_CUT:
        length = part * table.step[row]
        hinge = length * rng.random()
        x, y, z = x + hinge * direction.x, y + hinge * direction.y, z + hinge * direction.z
        if not in_germanium(outline, x, y, z):
            return
        record(event, x, y, z, kinetic - table.energy[row + 1])
        kinetic = table.energy[row + 1]
        scale = table.scattering[row] * part
        cosine = 1.0 + scale * math.log(1.0 - rng.random() * table.scattering_cut[row])
        direction = turned(direction, cosine, 2.0 * math.pi * rng.random())
        rest = length - hinge
        x, y, z = x + rest * direction.x, y + rest * direction.y, z + rest * direction.z
        if not in_germanium(outline, x, y, z):
            return
        chance = rng.random()
        if chance < part * table.brems[row]:
            shares = table.photon_share[row]
            at = rng.random() * (len(shares) - 1)
            node = int(at)
            share = shares[node] + (at - node) * (shares[node + 1] - shares[node])
            photon = min(share, 1.0) * kinetic
            put_photon(event, x, y, z, forward(direction, kinetic, rng), photon)
            kinetic -= photon
            row = row_of(table, kinetic)
            above = table.energy[row + 1]
            part = (kinetic - above) / (table.energy[row] - above)
            continue
        if positron and 1.0 - chance < part * table.annihilation[row]:
            energy, cosine = annihilation_energy(kinetic, rng)
            momentum = math.sqrt(kinetic * (kinetic + 2.0 * ELECTRON_MASS))
            first = turned(direction, cosine, 2.0 * math.pi * rng.random())
            put_photon(event, x, y, z, first, energy)
            second = remainder(momentum, direction, energy, first)
            put_photon(event, x, y, z, second, kinetic + 2.0 * ELECTRON_MASS - energy)
            return
        row, part = row + 1, 1.0
    record(event, x, y, z, kinetic)
    if positron:
        first = isotropic(rng)
        put_photon(event, x, y, z, first, ELECTRON_MASS)
        second = UnitVector(-first.x, -first.y, -first.z)
        put_photon(event, x, y, z, second, ELECTRON_MASS)
