"""Slowing down of electrons and positrons in tabulated steps, and single interactions.

Energies are in MeV, directions are unit vectors. Compton: Klein and Nishina, sampled as in
Nelson et al., SLAC-265 (1985), § 2.9. Annihilation in flight: Heitler's cross section.

Tabulated photon cross sections and electron slowing-down in germanium.

Sources: photons, NIST XCOM (the CSV file of this folder); collision stopping power, Bethe
formula with the density effect of Sternheimer, Berger and Seltzer, At. Data Nucl. Data Tables
30 (1984) 261; scattering, screened Rutherford with Molière's angle, Z. Naturf. 2a (1947) 133;
bremsstrahlung, Bethe and Heitler in the form of Koch and Motz, Rev. Mod. Phys. 31 (1959) 920,
with the limit of complete screening; annihilation in flight, Heitler, The Quantum Theory of
Radiation (1954), § 27.
"""

from __future__ import annotations

import functools
import math
from importlib import resources
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from cpunet.kernels import kernel
from cpunet.simulation.outline import Outline, in_germanium

Array = npt.NDArray[np.float64]

ELECTRON_MASS = 0.510998950
"""Electron mass in MeV."""
K_BINDING = 0.0111031
"""Binding energy of the K shell in MeV."""
PHOTON_CUT = 0.010
"""Photons below this energy (MeV) are absorbed locally: their path is < 0.1 mm."""
ELECTRON_CUT = 0.030
"""Electrons below this energy (MeV) stop locally: their range is < 0.01 mm."""

_TOP = 2.7
_LOSS_PER_STEP = 0.12
_PHOTON_NODES = 4096
_BREMS_NODES = 64
_DENSITY, _A, _Z = 5.323, 72.630, 32
_RADIUS = 2.8179403e-13
_ALPHA = 1 / 137.035999
_ATOMS = 6.02214076e23 * _DENSITY / _A
_EXCITATION = 350e-6
_STERNHEIMER = {"c": 5.1411, "x0": 0.3376, "x1": 3.6096, "a": 0.07188, "m": 3.3306}


class PhotonTable(NamedTuple):
    """Attenuation and fractions of the processes, on a grid equidistant in ln(energy)."""

    log_first: float
    per_log: float
    attenuation_per_mm: Array
    photoelectric: Array
    not_pair: Array


class ElectronTable(NamedTuple):
    """One row per step, each losing the same fraction of the energy; lengths in mm.

    ``energy`` (MeV) is the energy before the step. ``scattering`` is the scale b of the
    distribution exp(-(1 - cos)/b) of the deflection, ``scattering_cut`` the value of its
    integral at cos = -1. ``brems`` and ``annihilation`` are the probabilities of a hard photon
    and of annihilation in flight within a step. ``photon_share[row]`` holds quantiles of the
    energy of the hard photon relative to that of the electron.
    """

    log_top: float
    log_ratio: float
    energy: Array
    step: Array
    scattering: Array
    scattering_cut: Array
    brems: Array
    annihilation: Array
    photon_share: Array


@functools.cache
def photon_table() -> PhotonTable:
    """Photon cross sections of XCOM without coherent scattering, which deposits no energy."""
    source = resources.files(__package__) / "ge_cross_sections.csv"
    with source.open() as lines:
        data = np.loadtxt(lines, delimiter=",", comments=("#", "E_MeV"))
    energy, incoherent, photoelectric = data[:, 0], data[:, 2], data[:, 3]
    pair = data[:, 4] + data[:, 5]
    log = np.linspace(np.log(energy[0]), np.log(energy[-1]), _PHOTON_NODES)
    compton = np.exp(np.interp(log, np.log(energy), np.log(incoherent)))
    photo = np.exp(np.interp(log, np.log(energy), np.log(photoelectric)))
    # the logarithm diverges at threshold: (1 - threshold / energy)^3 removes the steepness
    grid = np.exp(log)
    above = energy > 1.03
    smooth = pair[above] / (1 - 2 * ELECTRON_MASS / energy[above]) ** 3
    rise = np.clip(1 - 2 * ELECTRON_MASS / grid, 0, None) ** 3
    pairs = rise * np.interp(log, np.log(energy[above]), smooth)
    total = compton + photo + pairs
    return PhotonTable(
        log_first=float(log[0]),
        per_log=float(1 / (log[1] - log[0])),
        attenuation_per_mm=total * _DENSITY / 10,
        photoelectric=photo / total,
        not_pair=(photo + compton) / total,
    )


@functools.cache
def electron_table() -> ElectronTable:
    """Steps of an electron from 2.7 MeV down to the cut."""
    ratio = 1 - _LOSS_PER_STEP
    rows = int(np.ceil(np.log(ELECTRON_CUT / 4 / _TOP) / np.log(ratio)))
    energy = np.asarray(_TOP * ratio ** np.arange(rows), np.float64)
    middle = energy * np.sqrt(ratio)
    # to collisions, and to photons below the cut
    most = np.minimum(middle, PHOTON_CUT)
    soft = _radiation(middle[:, np.newaxis], (np.arange(32) + 0.5) / 32 * most[:, np.newaxis])
    step = energy * _LOSS_PER_STEP / (_collision_loss(middle) + soft.mean(axis=1) * most)
    hard, quantiles = zip(*map(_hard_photons, middle), strict=True)
    # inverse of the first transport mean free path: -d<cos>/ds at s = 0
    momentum = np.sqrt(middle * (middle + 2 * ELECTRON_MASS))
    beta = momentum / (middle + ELECTRON_MASS)
    angle = _ALPHA * ELECTRON_MASS / momentum * _Z ** (1 / 3) / 0.885
    screening = angle**2 / 4 * (1.13 + 3.76 * (_ALPHA * _Z / beta) ** 2)
    size = 2 * np.pi * _RADIUS**2 * _Z * (_Z + 1) * (ELECTRON_MASS / (momentum * beta)) ** 2
    transport = _ATOMS / 10 * size * (np.log(1 + 1 / screening) - 1 / (1 + screening))
    turned = 1 - np.exp(-step * transport)
    # scale b for which exp(-x/b) on 0 < x < 2 has this mean (below 1)
    scale = np.array(
        [brentq(lambda b, m=m: b - 2 / np.expm1(2 / b) - m, 3e-3, 1e4) for m in turned]
    )
    # of positrons in flight, per mm
    gamma = 1 + middle / ELECTRON_MASS
    root = np.sqrt(gamma**2 - 1)
    bracket = (gamma**2 + 4 * gamma + 1) / root**2 * np.log(gamma + root) - (gamma + 3) / root
    annihilation = np.pi * _RADIUS**2 / (gamma + 1) * bracket * _ATOMS * _Z / 10
    return ElectronTable(
        log_top=float(np.log(_TOP)),
        log_ratio=float(np.log(ratio)),
        energy=energy,
        step=step,
        scattering=scale,
        scattering_cut=1 - np.exp(-2 / scale),
        brems=1 - np.exp(-step * np.array(hard)),
        annihilation=1 - np.exp(-step * annihilation),
        photon_share=np.stack(quantiles),
    )


def _collision_loss(kinetic: Array) -> Array:
    """Collision stopping power in MeV/mm."""
    gamma = 1 + kinetic / ELECTRON_MASS
    tau = gamma - 1
    beta2 = 1 - gamma**-2
    x = np.log10(np.sqrt(gamma**2 - 1))
    s = _STERNHEIMER
    bend = s["a"] * np.clip(s["x1"] - x, 0, None) ** s["m"]
    density = np.where(x < s["x0"], 0.0, 2 * np.log(10) * x - s["c"] + bend)
    form = 1 - beta2 + (tau**2 / 8 - (2 * tau + 1) * np.log(2)) / gamma**2
    logarithm = np.log(tau**2 * (tau + 2) / (2 * (_EXCITATION / ELECTRON_MASS) ** 2))
    scale = 2 * np.pi * _RADIUS**2 * ELECTRON_MASS * _ATOMS * _Z / 10
    return np.asarray(scale / beta2 * (logarithm + form - density))


def _radiation(kinetic: float | Array, photon: Array) -> Array:
    """K dΣ/dk in 1/mm: photon energy times macroscopic cross section per photon energy."""
    before = kinetic + ELECTRON_MASS
    after = before - photon
    ratio = after / before
    unscreened = np.log(2 * before * after / (photon * ELECTRON_MASS)) - 0.5
    logarithm = np.minimum(unscreened, np.log(183 * _Z ** (-1 / 3)))
    scale = 4 * _ALPHA * _RADIUS**2 * _Z * (_Z + 1) * _ATOMS / 10
    return np.asarray(scale * (1 + ratio**2 - 2 / 3 * ratio) * logarithm)


def _hard_photons(kinetic: float) -> tuple[float, Array]:
    """Photons above the cut: number per mm, and quantiles of their energy fraction k/T."""
    if kinetic <= PHOTON_CUT:
        return 0.0, np.ones(_BREMS_NODES)
    log = np.linspace(np.log(PHOTON_CUT), np.log(kinetic), 256)
    density = _radiation(kinetic, np.exp(log))
    cumulative = np.append(0.0, np.cumsum((density[1:] + density[:-1]) / 2))
    wanted = np.linspace(0, cumulative[-1], _BREMS_NODES)
    quantiles = np.exp(np.interp(wanted, cumulative, log)) / kinetic
    return float(np.trapezoid(density, log)), quantiles


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
        if not in_germanium(outline, x, y, z, 0.0):
            return
        record(event, x, y, z, kinetic - table.energy[row + 1])
        kinetic = table.energy[row + 1]
        scale = table.scattering[row] * part
        cosine = 1.0 + scale * math.log(1.0 - rng.random() * table.scattering_cut[row])
        direction = turned(direction, cosine, 2.0 * math.pi * rng.random())
        rest = length - hinge
        x, y, z = x + rest * direction.x, y + rest * direction.y, z + rest * direction.z
        if not in_germanium(outline, x, y, z, 0.0):
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
        cosine, up = 2.0 * rng.random() - 1.0, UnitVector(0.0, 0.0, 1.0)
        first = turned(up, cosine, 2.0 * math.pi * rng.random())
        put_photon(event, x, y, z, first, ELECTRON_MASS)
        second = UnitVector(-first.x, -first.y, -first.z)
        put_photon(event, x, y, z, second, ELECTRON_MASS)
