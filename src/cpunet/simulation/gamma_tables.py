"""Photons, electrons and positrons in germanium, as tables for `cpunet.simulation.gammas`.

Sources: photons, NIST XCOM (a CSV file of this folder); collision stopping power, Bethe formula
with the density effect of Sternheimer, Berger and Seltzer, At. Data Nucl. Data Tables 30 (1984)
261; scattering, screened Rutherford with Molière's angle, Z. Naturf. 2a (1947) 133;
bremsstrahlung, Bethe and Heitler in the form of Koch and Motz, Rev. Mod. Phys. 31 (1959) 920,
with the limit of complete screening; annihilation in flight, Heitler, The Quantum Theory of
Radiation (1954), § 27. Energies are in MeV.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from cpunet.simulation.geometry import FloatArray

ELECTRON_MASS = 0.510998950  # MeV
# photons below this energy (MeV) are absorbed locally: their path is < 0.1 mm
PHOTON_CUT = 0.010
# electrons below this energy (MeV) stop locally: their range is < 0.01 mm
ELECTRON_CUT = 0.030

_TOP = 2.7
_LOSS_PER_STEP = 0.12
LOG_TOP, LOG_RATIO = float(np.log(_TOP)), float(np.log(1 - _LOSS_PER_STEP))
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
    attenuation_per_mm: FloatArray
    photoelectric: FloatArray
    not_pair: FloatArray


class ElectronTable(NamedTuple):
    """One row per step, each losing the same fraction of the energy; lengths in mm.

    ``energy`` (MeV) is the energy before the step. ``scattering`` is the scale b of the
    distribution exp(-(1 - cos)/b) of the deflection, ``scattering_cut`` the value of its
    integral at cos = -1. ``brems`` and ``annihilation`` are the probabilities of a hard photon
    and of annihilation in flight within a step. ``photon_share[row]`` holds quantiles of the
    energy of the hard photon relative to that of the electron.
    """

    energy: FloatArray
    step: FloatArray
    scattering: FloatArray
    scattering_cut: FloatArray
    brems: FloatArray
    annihilation: FloatArray
    photon_share: FloatArray


@functools.cache
def photon_table() -> PhotonTable:
    """Photon cross sections of XCOM without coherent scattering, which deposits no energy."""
    file = Path(__file__).with_name("gamma_cross_sections.csv")
    data = np.loadtxt(file, delimiter=",", comments=("#", "E_MeV"))
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
    momentum = np.sqrt(middle * (middle + 2 * ELECTRON_MASS))
    beta = momentum / (middle + ELECTRON_MASS)
    gamma = 1 + middle / ELECTRON_MASS
    root = np.sqrt(gamma**2 - 1)
    # stopping power of collisions in MeV/mm, and of photons below the cut
    s, x, tau, beta2 = _STERNHEIMER, np.log10(root), gamma - 1, 1 - gamma**-2
    bend = s["a"] * np.clip(s["x1"] - x, 0, None) ** s["m"]
    density = np.where(x < s["x0"], 0.0, 2 * np.log(10) * x - s["c"] + bend)
    form = 1 - beta2 + (tau**2 / 8 - (2 * tau + 1) * np.log(2)) / gamma**2
    logarithm = np.log(tau**2 * (tau + 2) / (2 * (_EXCITATION / ELECTRON_MASS) ** 2))
    unit = 2 * np.pi * _RADIUS**2 * ELECTRON_MASS * _ATOMS * _Z / 10
    collisions = unit / beta2 * (logarithm + form - density)
    most = np.minimum(middle, PHOTON_CUT)
    soft = _radiation(middle[:, np.newaxis], (np.arange(32) + 0.5) / 32 * most[:, np.newaxis])
    step = energy * _LOSS_PER_STEP / (collisions + soft.mean(axis=1) * most)
    # photons above the cut: number per mm, and quantiles of their energy fraction k/T
    hard, quantiles = np.zeros(rows), np.ones((rows, _BREMS_NODES))
    for i in np.flatnonzero(middle > PHOTON_CUT):
        log = np.linspace(np.log(PHOTON_CUT), np.log(middle[i]), 256)
        density = _radiation(middle[i], np.exp(log))
        cumulative = np.append(0.0, np.cumsum((density[1:] + density[:-1]) / 2))
        wanted = np.linspace(0, cumulative[-1], _BREMS_NODES)
        quantiles[i] = np.exp(np.interp(wanted, cumulative, log)) / middle[i]
        hard[i] = np.trapezoid(density, log)
    # inverse of the first transport mean free path: -d<cos>/ds at s = 0
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
    bracket = (gamma**2 + 4 * gamma + 1) / root**2 * np.log(gamma + root) - (gamma + 3) / root
    annihilation = np.pi * _RADIUS**2 / (gamma + 1) * bracket * _ATOMS * _Z / 10
    return ElectronTable(
        energy=energy,
        step=step,
        scattering=scale,
        scattering_cut=1 - np.exp(-2 / scale),
        brems=1 - np.exp(-step * hard),
        annihilation=1 - np.exp(-step * annihilation),
        photon_share=quantiles,
    )


def _radiation(kinetic: float | FloatArray, photon: FloatArray) -> FloatArray:
    """K dΣ/dk in 1/mm: photon energy times macroscopic cross section per photon energy."""
    before = kinetic + ELECTRON_MASS
    after = before - photon
    ratio = after / before
    unscreened = np.log(2 * before * after / (photon * ELECTRON_MASS)) - 0.5
    logarithm = np.minimum(unscreened, np.log(183 * _Z ** (-1 / 3)))
    scale = 4 * _ALPHA * _RADIUS**2 * _Z * (_Z + 1) * _ATOMS / 10
    return np.asarray(scale * (1 + ratio**2 - 2 / 3 * ratio) * logarithm)
