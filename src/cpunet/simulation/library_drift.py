"""Compiled loops that build the library: pulses at its nodes, and their accuracy."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from cpunet.kernels import kernel
from cpunet.simulation.drift import FWHM_PER_SIGMA, smear_and_sample
from cpunet.simulation.field_lookup import DriftMaps, in_active_volume
from cpunet.simulation.library_lookup import (
    LATE,
    OUTSIDE,
    Float32Array,
    PulseLibrary,
    add_pulse,
)
from cpunet.simulation.signals import Task, point_signal
from cpunet.simulation.velocity import FloatArray

IntArray = npt.NDArray[np.int64]

MARGIN_NS = 64.0
"""Time by which pulses are stored before the charge is released. Neighbours whose half-maximum
times differ by more are of different kinds (another path or another carrier)."""


@kernel
def bend(library: PulseLibrary, cells: IntArray, size: int, bends: Float32Array) -> None:
    """Curvature of the half-maximum time in r and in z: ``bend u (1 - u)`` is added.

    It is the mean second difference at the corners for which both neighbours exist.
    """
    nr, nz = library.column.shape
    azimuths = len(library.cos4)
    for c in range(len(cells)):
        for axis in range(2):
            di, dj = (size, 0) if axis == 0 else (0, size)
            found = 0
            for corner in range(4):
                i = cells[c, 0] + (corner & 1) * size
                j = cells[c, 1] + (corner >> 1) * size
                if i < di or j < dj or i + di >= nr or j + dj >= nz:
                    continue
                low, high = library.column[i - di, j - dj], library.column[i + di, j + dj]
                if low < 0 or high < 0:
                    continue
                found += 1
                middle = library.column[i, j]
                for k in range(azimuths):
                    bends[c, axis, k] += (
                        2.0 * library.half_ns[middle * azimuths + k]
                        - library.half_ns[low * azimuths + k]
                        - library.half_ns[high * azimuths + k]
                    )
            if found > 0:
                for k in range(azimuths):
                    bends[c, axis, k] *= 0.5 / found


@kernel(parallel=True)
def drift_nodes(
    library: PulseLibrary,
    maps: DriftMaps,
    task: Task,
    places: IntArray,
    rows: Float32Array,
    facts: FloatArray,
) -> None:
    """Fill the rows and the facts of each node.

    The facts are its state (0, `OUTSIDE` or `LATE`), number of samples, half-maximum time,
    final value and trapped fraction.
    """
    azimuths, energies = len(library.cos4), library.energies_kev
    for place in prange(len(places)):
        r, z = places[place, 0] / library.per_mm, places[place, 1] / library.per_mm
        signal = np.zeros(task.per_sample * (library.margin + task.n_samples))
        for k in range(azimuths):
            node = place * azimuths + k
            if not in_active_volume(maps, r, 0.0, z):
                facts[node, 0] = OUTSIDE
                continue
            length = 0
            for e in range(len(energies)):
                hit = _at_azimuth(r, z, float(k), azimuths, energies[e])
                own = rows[node, e * library.phases : (e + 1) * library.phases]
                flat, arrived, trapped = _fine_pulse(library, maps, task, hit, signal, own)
                length = max(length, flat)
            if not arrived:
                facts[node, 0] = LATE
            facts[node, 1] = length
            facts[node, 2] = _half_time(signal, task.per_sample * library.margin) * task.step_ns
            facts[node, 3], facts[node, 4] = signal[-1], trapped


@kernel
def _at_azimuth(r: float, z: float, k: float, azimuths: int, energy: float) -> FloatArray:
    phi = 0.25 * math.pi * k / (azimuths - 1)
    return np.array([r * math.cos(phi), r * math.sin(phi), z, energy])


@kernel
def _fine_pulse(
    library: PulseLibrary,
    maps: DriftMaps,
    task: Task,
    hit: FloatArray,
    signal: FloatArray,
    rows: Float32Array,
) -> tuple[int, bool, float]:
    """Fill the rows (phases, samples) with the smeared and averaged pulse of a hit.

    `signal` receives the pulse of the point charge, with zeros for the margin before it.
    Returns the number of samples up to the first constant one, whether the charge is
    collected, and the trapped fraction.
    """
    before = library.margin * task.per_sample
    last, arrived, fwhm, trapped = point_signal(maps, hit, task, signal[before:])
    group = task.per_sample // library.phases
    sample = np.empty(rows.shape[1])
    for p in range(library.phases):
        # the samples left out at the front are zero
        late = p * group
        sample[:] = 0.0
        smear_and_sample(
            signal[late:],
            task.per_sample,
            fwhm / FWHM_PER_SIGMA,
            last + before - late,
            1.0,
            sample,
        )
        for j in range(len(sample)):  # a slice assignment would compile its shape errors
            rows[p, j] = sample[j]
    # the cloud is truncated at two FWHM
    end = (last + before + int(2.0 * fwhm) + 2) // task.per_sample + 2
    return min(end, rows.shape[1]), arrived, trapped


@kernel
def _half_time(signal: FloatArray, zero: int) -> float:
    """Fractional step after `zero` at which a pulse first reaches half its final value."""
    half = 0.5 * signal[-1]
    for k in range(zero + 1, len(signal)):
        if signal[k] >= half and signal[k] > signal[k - 1]:
            return float(k - zero - (signal[k] - half) / (signal[k] - signal[k - 1]))
    return 0.0


@kernel(parallel=True)
def compare(
    library: PulseLibrary, maps: DriftMaps, task: Task, places: FloatArray, worst: FloatArray
) -> None:
    """Largest deviation at points (fine steps), at every other midpoint of two azimuths."""
    for place in prange(len(places)):
        r, z = places[place, 0] / library.per_mm, places[place, 1] / library.per_mm
        signal = np.zeros(task.per_sample * (library.margin + task.n_samples))
        rows = np.empty((library.phases, library.margin + task.n_samples), np.float32)
        for k in range(0, len(library.cos4) - 1, 2):
            energy = _between(library.energies_kev, k)
            hit = _at_azimuth(r, z, k + 0.5, len(library.cos4), energy)
            if not in_active_volume(maps, hit[0], hit[1], hit[2]) or (
                _spread(library, places[place], k) > MARGIN_NS
            ):
                worst[place] = np.inf
                break
            _, arrived, _ = _fine_pulse(library, maps, task, hit, signal, rows)
            if not arrived:
                worst[place] = np.inf
                break
            deviation = _deviation(library, hit, rows)
            worst[place] = max(worst[place], deviation)


@kernel
def _between(energies: FloatArray, k: int) -> float:
    """Midpoint between two energies of the library; another pair for each k."""
    if len(energies) == 1:
        return float(energies[0])
    e = k % (len(energies) - 1)
    return float(0.5 * (energies[e] + energies[e + 1]))


@kernel
def _spread(library: PulseLibrary, place: FloatArray, k: int) -> float:
    """Range (ns) of the half-maximum times of the corners around a point."""
    size = library.cell[int(place[0]), int(place[1])]
    i, j = int(place[0]) // size * size, int(place[1]) // size * size
    low, high = np.inf, -np.inf
    for corner in range(8):
        column = library.column[i + (corner & 1) * size, j + ((corner >> 1) & 1) * size]
        half = library.half_ns[column * len(library.cos4) + k + (corner >> 2)]
        low, high = min(low, half), max(high, half)
    return high - low


@kernel
def _deviation(library: PulseLibrary, hit: FloatArray, rows: Float32Array) -> float:
    """Largest deviation between interpolated and exact samples over all phases.

    The largest rise in one sample also counts, relative to itself.
    """
    n = rows.shape[1] - library.margin
    worst = 0.0
    for phase in range(library.phases):
        out = np.zeros(n, np.float32)
        steps = np.zeros(n + 1)
        add_pulse(library, hit, 1.0, phase, out, steps)
        flat = quick_rise = exact_rise = quick_before = exact_before = 0.0
        for m in range(n):
            flat += steps[m]
            quick, exact = out[m] + flat, rows[phase, library.margin + m]
            worst = max(worst, abs(quick - exact))
            if m > 0:
                quick_rise = max(quick_rise, quick - quick_before)
                exact_rise = max(exact_rise, exact - exact_before)
            quick_before, exact_before = quick, exact
        if exact_rise > 0.0:
            worst = max(worst, abs(quick_rise / exact_rise - 1.0))
    return worst
