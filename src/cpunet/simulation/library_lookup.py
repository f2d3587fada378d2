"""Pre-computed pulses of single charges, and their interpolation at any point.

Each node holds the pulse already smeared by its cloud and averaged over one output sample,
every few ns. A pulse shifted in time is therefore a cubic combination of four rows of samples.
Pulses of neighbouring nodes are shifted to a common half-maximum time before they are
averaged. That time is interpolated separately and more smoothly, which preserves the steepness
of edges.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel
from cpunet.simulation.velocity import FloatArray

Float32Array = npt.NDArray[np.float32]

# Entries of `PulseLibrary.column` at grid points without pulses: not tried yet, outside the
# active germanium, not collected within the record.
UNTRIED, OUTSIDE, LATE = -3, -2, -1

# Energy above which repulsion widens a typical cloud more than diffusion does.
_REPELLING_KEV = 100.0


class PulseLibrary(NamedTuple):
    """Pulses of point charges at columns of nodes: points in (r, z), each at all azimuths.

    Cells of 1, 2, 4, ... fine steps tile the (r, z) plane. The pulse inside a cell is
    interpolated between its four corners and two azimuths. Azimuths are equidistant from 0 to
    45 degrees; cubic symmetry maps all others onto these.

    ``cell`` (nr, nz): fine steps per side of the cell that covers each fine cell, 0 where
    charges are drifted instead. ``number`` (nr, nz): its row in ``bend_ns``, which is
    (cells, 2, azimuths). ``column`` (nr + 1, nz + 1): number of the column at each corner,
    negative where there is none. Node ``column * azimuths + k`` has the pulse
    ``pulses[start:]``, of shape (energies, phases, `samples`). Sample j of phase p is at time
    ``(j - margin + p / phases) * dt_ns``, and the last one is ``final`` in all phases.
    ``trapped`` is the fraction lost to trapping. ``half_ns`` is the half-maximum time. Inside
    a cell it varies by ``bend_ns u (1 - u)`` along r and z each, in addition to the linear
    interpolation.
    """

    pulses: Float32Array
    start: npt.NDArray[np.int64]
    samples: npt.NDArray[np.int64]
    half_ns: FloatArray
    final: Float32Array
    trapped: FloatArray
    cell: npt.NDArray[np.int64]
    number: npt.NDArray[np.int64]
    bend_ns: Float32Array
    column: npt.NDArray[np.int64]
    energies_kev: FloatArray
    cos4: FloatArray
    phases: int
    margin: int
    dt_ns: float
    per_mm: float


@kernel
def covers(library: PulseLibrary, x: float, y: float, z: float, energy_kev: float) -> bool:
    """Whether the pulse of a hit can be interpolated."""
    i, j = int(math.hypot(x, y) * library.per_mm), int(z * library.per_mm)
    nr, nz = library.cell.shape
    if z < 0.0 or i >= nr or j >= nz:
        return False
    energies = library.energies_kev
    within = len(energies) == 1 or energies[0] <= energy_kev <= energies[-1]
    return bool(within and library.cell[i, j] > 0)


@kernel
def add_pulse(
    library: PulseLibrary,
    hit: FloatArray,
    weight: float,
    delay: int,
    out: Float32Array,
    steps: FloatArray,
) -> float:
    """Add `weight` times the pulse of a hit that `covers` accepts; return the trapped part.

    Parameters
    ----------
    library
        Pulses of the detector.
    hit
        x, y, z in mm, energy in keV.
    weight
        Factor of the pulse.
    delay
        Start of the record after the release of the charge, in phases of a sample.
    out
        Samples of the record. The pulse is added to them until it is constant.
    steps
        Array one longer than `out`: values added to all samples from an index onwards.
    """
    r = math.hypot(hit[0], hit[1])
    p, q = r * library.per_mm, hit[2] * library.per_mm
    size = library.cell[int(p), int(q)]
    i, j = int(p) // size * size, int(q) // size * size
    u, v = (p - i) / size, (q - j) / size
    # cos 4 phi = 1 - 8 c^2 (1 - c^2) with c = x / r
    c2 = (hit[0] / r) ** 2 if r > 0.0 else 1.0  # r * r may underflow
    cos4 = 1.0 - 8.0 * c2 * (1.0 - c2)
    cosines = library.cos4
    azimuths = len(cosines)
    k = 0
    while k < azimuths - 2 and cosines[k + 1] >= cos4:
        k += 1
    w = (cosines[k] - cos4) / (cosines[k] - cosines[k + 1])
    first = (
        library.column[i, j] * azimuths,
        library.column[i + size, j] * azimuths,
        library.column[i, j + size] * azimuths,
        library.column[i + size, j + size] * azimuths,
    )
    parts = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
    bend = library.bend_ns[library.number[int(p), int(q)]]
    half = _smooth_half(library, cos4, first, parts, bend, u * (1 - u), v * (1 - v))
    per_ns = library.phases / library.dt_ns
    trapped = 0.0
    for corner in range(8):
        node = first[corner & 3] + k + (corner >> 2)
        part = weight * parts[corner & 3] * (w if corner >> 2 else 1.0 - w)
        trapped += part * library.trapped[node]
        shift = (library.half_ns[node] - half) * per_ns + delay
        for row in range(len(library.energies_kev)):
            share = _energy_weight(library.energies_kev, row, hit[3])
            _add_shifted(library, node, row, part * share, shift, out, steps)
    return trapped


@kernel
def _smooth_half(
    library: PulseLibrary,
    cos4: float,
    first: tuple[int, int, int, int],
    parts: tuple[float, float, float, float],
    bend: Float32Array,
    uu: float,
    vv: float,
) -> float:
    """Half-maximum time: a parabola in r and z each, a polynomial through all azimuths.

    Uses the barycentric formula at Chebyshev points (Berrut and Trefethen, SIAM Review 46
    (2004) 501).
    """
    last = len(library.cos4) - 1
    above = below = 0.0
    for k in range(last + 1):
        half = uu * bend[0, k] + vv * bend[1, k]
        for corner in range(4):
            half += parts[corner] * library.half_ns[first[corner] + k]
        gap = cos4 - library.cos4[k]
        if abs(gap) < 1e-12:
            return float(half)
        share = (0.5 if k == 0 or k == last else 1.0) * (1 - 2 * (k & 1)) / gap
        above += share * half
        below += share
    return above / below


@kernel
def _energy_weight(energies: FloatArray, row: int, energy: float) -> float:
    """Weight of a row's pulse: a polynomial through all rows in the cloud's squared width.

    A pulse obeys the heat equation with the squared width as time. With repulsion the cube of
    the width grows with energy.
    """
    weight = 1.0
    for other in range(len(energies)):
        if other != row:
            x = _cloud_scale(energies[other])
            weight *= (_cloud_scale(energy) - x) / (_cloud_scale(energies[row]) - x)
    return weight


@kernel
def _cloud_scale(energy_kev: float) -> float:
    """Approximate scaling of the squared width of a self-repelling cloud with energy."""
    return float((1.0 + energy_kev / _REPELLING_KEV) ** (2.0 / 3.0))


@kernel
def _add_shifted(
    library: PulseLibrary,
    node: int,
    row: int,
    weight: float,
    shift: float,
    out: Float32Array,
    steps: FloatArray,
) -> None:
    """Add a node's pulse, read `shift` phases later, by a cubic through four fine samples."""
    base = math.floor(shift)
    f = shift - base
    cubic = (
        -f * (f - 1.0) * (f - 2.0) / 6.0,
        (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0,
        -(f + 1.0) * f * (f - 2.0) / 2.0,
        (f + 1.0) * f * (f - 1.0) / 6.0,
    )
    length, phases = library.samples[node], library.phases
    pulse = library.start[node] + row * phases * length
    # row and first sample of each tap; first samples differ by at most one
    f0, f1, f2, f3 = base - 1, base, base + 1, base + 2
    s0, s1 = f0 // phases + library.margin, f1 // phases + library.margin
    s2, s3 = f2 // phases + library.margin, f3 // phases + library.margin
    # before the record the pulse is zero; the last sample of a row is already constant
    begin = max(0, -s0)
    end = min(max(length - s3, begin), len(out))
    n = end - begin
    b0 = pulse + f0 % phases * length + s0 + begin
    b1 = pulse + f1 % phases * length + s1 + begin
    b2 = pulse + f2 % phases * length + s2 + begin
    b3 = pulse + f3 % phases * length + s3 + begin
    _add_mixed(
        library.pulses[b0 : b0 + n],
        library.pulses[b1 : b1 + n],
        library.pulses[b2 : b2 + n],
        library.pulses[b3 : b3 + n],
        (weight * cubic[0], weight * cubic[1], weight * cubic[2], weight * cubic[3]),
        out[begin:end],
    )
    steps[end] += weight * library.final[node]


@kernel(fastmath=True)
def _add_mixed(
    a: Float32Array,
    b: Float32Array,
    c: Float32Array,
    d: Float32Array,
    factors: tuple[float, float, float, float],
    out: Float32Array,
) -> None:
    w0, w1 = np.float32(factors[0]), np.float32(factors[1])
    w2, w3 = np.float32(factors[2]), np.float32(factors[3])
    for m in range(len(out)):
        out[m] += w0 * a[m] + w1 * b[m] + w2 * c[m] + w3 * d[m]
