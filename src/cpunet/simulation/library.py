"""Pre-computed pulses on a grid in r, z and azimuth, and interpolation between them.

Cubic symmetry leaves azimuths from 0 to 45 degrees.  Pulses of neighbouring grid points
are shifted to a common half-height time before they are averaged, and that time is
interpolated on its own, so that edges stay as steep as they are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from cpunet.simulation.drift import DriftMaps, Maps, drift_maps, in_active_volume
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.signals import cloud_numbers, point_signal
from cpunet.simulation.velocity import FloatArray

# Energies (keV) at which the width of a self-repelling cloud is tabulated.
_ENERGIES_KEV = (0.0, 30.0, 100.0, 250.0, 500.0, 1000.0, 1750.0, 2650.0)
# Grid points whose half-height times differ by more belong to different kinds of pulses
# (collected along another path, or reaching half height by the other carrier).
_MAX_SPREAD_NS_PER_MM = 60.0


class Library(NamedTuple):
    """Pulses of point charges at grid nodes (r, z, azimuth).

    ``pulses`` is (nr, nz, na, samples), block means of ``step_ns``; ``half_ns`` the time
    of half height and ``last`` the sample from which on a pulse is flat, (nr, nz, na);
    ``fwhm_ns`` (nr, nz, na, energies) the duration of the cloud; ``known`` (nr, nz) the
    nodes with pulses.  Azimuths are equidistant in cos 4 phi.
    """

    pulses: npt.NDArray[np.float32]
    half_ns: FloatArray
    last: npt.NDArray[np.int64]
    fwhm_ns: FloatArray
    energies_kev: FloatArray
    known: npt.NDArray[np.bool_]
    per_mm: float
    step_ns: float
    core_mm: float


def build_library(fields: Maps, settings: SimulationSettings) -> Library:
    """Simulate a pulse at every node of the library's grid, in parallel.

    Times scale with the number of nodes: seconds for a large detector at 1 mm.
    """
    maps = drift_maps(fields)
    shape = [
        math.floor((n - 1) * fields.grid_mm / settings.library_grid_mm) + 2
        for n in fields.potential_V.shape
    ]
    nodes = (shape[0], shape[1], settings.library_angles)
    group = round(settings.library_step_ns / settings.step_ns)
    energies = np.array(_ENERGIES_KEV if settings.self_repulsion else _ENERGIES_KEV[:1])
    library = Library(
        pulses=np.zeros((*nodes, settings.n_steps // group), np.float32),
        half_ns=np.zeros(nodes),
        last=np.zeros(nodes, np.int64),
        fwhm_ns=np.zeros((*nodes, len(energies))),
        energies_kev=energies,
        known=np.zeros(nodes[:2], np.bool_),
        per_mm=1 / settings.library_grid_mm,
        step_ns=settings.library_step_ns,
        core_mm=settings.library_core_mm,
    )
    _fill(library, maps, cloud_numbers(fields, settings), settings.step_ns, group)
    longest = int(library.last.max()) + 2
    return library._replace(pulses=np.ascontiguousarray(library.pulses[..., :longest]))


@njit(cache=True, nogil=True, parallel=True)
def _fill(
    library: Library,
    maps: DriftMaps,
    cloud: tuple[float, float, float, bool],
    step_ns: float,
    group: int,
) -> None:
    for row in prange(library.known.shape[0]):
        _fill_row(library, row, maps, cloud, step_ns, group)


@njit(cache=True, nogil=True)
def _fill_row(
    library: Library,
    row: int,
    maps: DriftMaps,
    cloud: tuple[float, float, float, bool],
    step_ns: float,
    group: int,
) -> None:
    _, nz, na, n = library.pulses.shape
    signal = np.empty(n * group)
    hit = np.zeros(4)
    r = row / library.per_mm
    for j in range(nz):
        hit[2] = j / library.per_mm
        if not in_active_volume(maps, r, 0.0, hit[2]):
            continue
        library.known[row, j] = True
        for k in range(na):
            phi = math.acos(1.0 - 2.0 * k / (na - 1)) / 4.0
            hit[0], hit[1] = r * math.cos(phi), r * math.sin(phi)
            widths = library.fwhm_ns[row, j, k]
            # the last energy's pulse is that of any: the cloud does not change it
            for e in range(len(widths)):
                hit[3] = library.energies_kev[e]
                last, _, fwhm = point_signal(maps, hit, cloud, step_ns, signal)
                widths[e] = fwhm * step_ns
            library.last[row, j, k] = min(last // group + 1, n - 1)
            library.half_ns[row, j, k] = _half_time(signal) * step_ns
            for m in range(n):
                library.pulses[row, j, k, m] = signal[m * group : (m + 1) * group].mean()


@njit(cache=True, nogil=True)
def _half_time(signal: FloatArray) -> float:
    """Step, with its fraction, at which a pulse first passes half its final height."""
    half = 0.5 * signal[len(signal) - 1]
    for k in range(1, len(signal)):
        if signal[k] >= half and signal[k] > signal[k - 1]:
            return float(k - (signal[k] - half) / (signal[k] - signal[k - 1]))
    return 0.0


@njit(cache=True, nogil=True)
def covers(library: Library, x: float, y: float, z: float) -> bool:
    """Whether all nodes around a place have pulses and the contact is far enough."""
    r = math.hypot(x, y)
    if z < 0.0 or r * r + z * z < library.core_mm**2:
        return False
    i, j = int(r * library.per_mm), int(z * library.per_mm)
    nr, nz = library.known.shape
    if i + 1 >= nr or j + 1 >= nz:
        return False
    known = library.known
    if not (known[i, j] and known[i + 1, j] and known[i, j + 1] and known[i + 1, j + 1]):
        return False
    half = library.half_ns
    for k in range(half.shape[2]):
        a, b, c, d = half[i, j, k], half[i + 1, j, k], half[i, j + 1, k], half[i + 1, j + 1, k]
        if (max(a, b, c, d) - min(a, b, c, d)) * library.per_mm > _MAX_SPREAD_NS_PER_MM:
            return False
    return True


@njit(cache=True, nogil=True, fastmath=True)
def interpolate(
    library: Library, hit: FloatArray, signal: npt.NDArray[np.float32]
) -> tuple[int, float]:
    """Fill `signal` with the pulse of a point charge at a hit that `covers` accepts.

    Returns the sample from which on it is flat, and the duration (FWHM, ns) of its cloud.
    """
    x, y, z = hit[0], hit[1], hit[2]
    r = math.hypot(x, y)
    p, q = r * library.per_mm, z * library.per_mm
    i, j = int(p), int(q)
    u, v = p - i, q - j
    # cos 4 phi = 8 c^4 - 8 c^2 + 1 with c = x / r
    c2 = x * x / (r * r) if r > 0.0 else 1.0
    s = 4.0 * c2 * (1.0 - c2) * (library.half_ns.shape[2] - 1)
    k = min(int(s), library.half_ns.shape[2] - 2)
    w = s - k
    e, part = _energy_row(library.energies_kev, hit[3])
    half, fwhm = 0.0, 0.0
    for corner in range(8):
        di, dj, dk = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if di else 1 - u) * (v if dj else 1 - v) * (w if dk else 1 - w)
        half += weight * library.half_ns[i + di, j + dj, k + dk]
        widths = library.fwhm_ns[i + di, j + dj, k + dk]
        upper = min(e + 1, len(widths) - 1)
        fwhm += weight * ((1 - part) * widths[e] + part * widths[upper])
    end = 0
    for corner in range(8):
        di, dj, dk = corner & 1, (corner >> 1) & 1, corner >> 2
        shift = (library.half_ns[i + di, j + dj, k + dk] - half) / library.step_ns
        end = max(end, library.last[i + di, j + dj, k + dk] - math.floor(shift))
    end = min(end, len(signal) - 1)
    signal[: end + 1] = 0.0
    for corner in range(8):
        di, dj, dk = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if di else 1 - u) * (v if dj else 1 - v) * (w if dk else 1 - w)
        shift = (library.half_ns[i + di, j + dj, k + dk] - half) / library.step_ns
        _add_shifted(
            library.pulses[i + di, j + dj, k + dk],
            np.float32(weight),
            shift,
            library.last[i + di, j + dj, k + dk],
            signal[: end + 1],
        )
    signal[end + 1 :] = signal[end]
    return end, fwhm


@njit(cache=True, nogil=True, fastmath=True)
def _add_shifted(
    pulse: npt.NDArray[np.float32],
    weight: np.float32,
    shift: float,
    last: int,
    signal: npt.NDArray[np.float32],
) -> None:
    """Add `weight` times `pulse`, read `shift` samples later, to `signal`."""
    base = math.floor(shift)
    w1 = np.float32(weight * (shift - base))
    w0 = np.float32(weight) - w1
    n = len(signal)
    begin = min(max(0, -base), n)
    flat = min(max(last - base, begin), n)
    for m in range(flat - begin):
        signal[begin + m] += w0 * pulse[begin + base + m] + w1 * pulse[begin + base + m + 1]
    final = weight * pulse[len(pulse) - 1]
    for m in range(flat, n):
        signal[m] += final


@njit(cache=True, nogil=True)
def _energy_row(energies: FloatArray, energy: float) -> tuple[int, float]:
    if len(energies) == 1:
        return 0, 0.0
    row = 0
    while row < len(energies) - 2 and energies[row + 1] <= energy:
        row += 1
    return row, (energy - energies[row]) / (energies[row + 1] - energies[row])
