r"""Drift of one electron and one hole through the field maps, and the charge cloud on its way.

Carriers drift in explicit Euler steps. The cloud is a Gaussian whose width evolves along the
path of the holes; the pulse of a point charge is convolved with a Gaussian as long as the cloud
takes to enter the contact.
"""

from __future__ import annotations

import math

import numpy as np

from cpunet.kernels import kernel
from cpunet.simulation.drift_maps import HOLE, DriftMaps, carrier_velocity, in_ditch, look_up
from cpunet.simulation.geometry import FloatArray

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
_MAX_REPULSION = 0.05
_CUT_FWHM = 2.0


@kernel(inline="always")
def cloud_after_step(
    size: float,
    speed: float,
    speed_before: float,
    field: float,
    slope: float,
    diffusion: float,
    repulsion: float,
    step_ns: float,
    step: int,
) -> float:
    r"""FWHM (mm) of the cloud after one step.

    The cloud is stretched in proportion to the speed, then grows by diffusion and by siggen's
    self-repulsion. For its FWHM :math:`s`

    .. math:: \frac{ds}{dt} = \frac{D_s}{s} + \frac{K}{s^2} \frac{dv}{dE}, \qquad
        D_s = 8 \ln 2 \cdot D.

    `diffusion` is :math:`D_s / (v/E)`, `repulsion` is :math:`K`, proportional to the charge.

    Large steps of a small cloud, which would overshoot, are integrated in powers of s,

    .. math:: s_{k+1}^2 = 2 D_s\, \Delta t + \left[s_k^2 (s_k + 3 R\, \Delta t)\right]^{2/3},
        \qquad R = \frac{K}{s_k^2} \frac{dv}{dE}.
    """
    if diffusion == 0.0 and repulsion == 0.0:
        return size
    if step == 0 or speed_before <= 0.0 or field <= 0.0:
        return size
    size *= speed / speed_before
    d = diffusion * speed / field
    r = min(repulsion * slope / (size * size), _MAX_REPULSION)
    growth = d / size + r
    if growth > 0.05 or growth * step_ns > 0.1:
        cube = size * size * (size + 3.0 * r * step_ns)
        return math.sqrt(2.0 * d * step_ns + cube ** (2.0 / 3.0))
    return size + growth * step_ns


@kernel(fastmath=True)
def smear_and_sample(
    signal: FloatArray, per_sample: int, sigma: float, last: int, weight: float, out: FloatArray
) -> None:
    r"""Convolve a signal with a Gaussian, average it over blocks and add it to `out`.

    .. math:: o_j \leftarrow o_j + \frac{w}{n} \sum_{k=jn}^{(j+1)n-1} (g_\sigma * S)_k

    Parameters
    ----------
    signal
        Pulse :math:`S` of a point charge, one value per step; zero before the record.
    per_sample
        Number of steps :math:`n` per sample of `out`.
    sigma
        Standard deviation of the Gaussian in steps.
    last
        Step after which the signal is constant.
    weight
        Factor :math:`w` of the signal.
    out
        Samples to which the result is added.
    """
    reach = 0 if sigma < 0.3 else int(_CUT_FWHM * FWHM_PER_SIGMA * sigma) + 1
    # the Gaussian, summed over a block and normalised
    kernel = np.zeros(per_sample + 2 * reach)
    norm = 0.0
    for d in range(-reach, reach + 1):
        height = math.exp(-0.5 * (d / sigma) ** 2) if d != 0 else 1.0
        norm += height * per_sample
        for m in range(per_sample):
            kernel[d + reach + m] += height
    kernel = kernel / norm
    final = weight * signal[len(signal) - 1]
    for j in range(len(out)):
        begin = j * per_sample - reach
        if begin >= last:
            out[j] += final
            continue
        low = max(0, -begin)
        high = min(len(kernel), len(signal) - begin)
        total = 0.0
        for m in range(low, high):
            total += kernel[m] * signal[begin + m]
        for m in range(max(high, 0), len(kernel)):
            total += kernel[m] * signal[len(signal) - 1]
        out[j] += weight * total


Place = tuple[float, float, float]  # x, y, z in mm

# A carrier is collected once its signal can change by less than this fraction of full scale.
_COLLECTED = 5e-5
# Holes that move slowly along the edge of the contact also count as collected.
_AT_CONTACT, _CREEPING = 0.999, 2e-4


@kernel
def drift(
    maps: DriftMaps,
    carrier: int,
    start: Place,
    step_ns: float,
    stride: int,
    cloud: tuple[float, float, float],
    signal: FloatArray,
    path: FloatArray,
) -> tuple[int, bool, float, float, float]:
    r"""Drift one charge until it is collected, and add its induced signal to `signal`.

    With explicit Euler steps :math:`\mathbf{x}_{k+1} = \mathbf{x}_k + \mathbf{v}_k \Delta t`,
    a hole (+) or electron (-) induces (Shockley-Ramo)

    .. math:: S_k = \pm \sum_{j=1}^{k} e^{-(j - 1/2)\, \Delta t / \tau}
        \left[\phi_w(\mathbf{x}_j) - \phi_w(\mathbf{x}_{j-1})\right]

    with the weighting potential :math:`\phi_w` and the trapping time :math:`\tau`. Without
    trapping this is the change of the weighting potential since the start.

    Parameters
    ----------
    maps
        Field maps and velocities.
    carrier
        `ELECTRON` or `HOLE`.
    start
        Starting point x, y, z in mm.
    step_ns, stride
        Duration of one step in ns, and the number of short steps it replaces. The velocity
        is extrapolated linearly to the mean over these.
    cloud
        Initial FWHM in mm (0: a point), diffusion constant D/(v/E) and repulsion constant
        (see `cpunet.simulation.drift`).
    signal
        Record with one value per step. The weighting potential gained (hole) or lost
        (electron) is added to it, up to the end of the record.
    path
        Array for the positions (steps, 3), or an empty array.

    Returns
    -------
    tuple
        Last step, whether the charge was collected, FWHM (mm) and speed (mm/ns) there, and
        the signal lost to trapping.
    """
    x, y, z = start
    ux = uy = uz = 0.0
    ahead = (stride - 1) / (2 * stride)
    sign = 1.0 if carrier == HOLE else -1.0
    size, diffusion, repulsion = cloud
    first = last = speed = induced = 0.0
    rate = maps.trapping_per_ns[carrier]
    # surviving charge, half a step earlier
    left, survival = math.exp(0.5 * rate * step_ns), math.exp(-rate * step_ns)
    k, n, collected = 0, len(signal), False
    while k < n:
        r = math.sqrt(x * x + y * y)  # math.hypot takes a sixth of the loop
        er, ez, wp, potential, usable = look_up(maps, r, z)
        if not usable:
            # beyond the surface of a contact: the remaining signal is induced in this step;
            # electrons at the ditch end as in siggen, as if at the lithium about it
            wp = 1.0 if last > 0.3 else 0.0
        if k == 0:
            first = wp
        if rate == 0.0:
            induced = sign * (wp - first)
        elif k > 0:
            left *= survival
            induced += sign * (wp - last) * left
        signal[k] += induced
        if len(path) > 0:
            path[k, 0], path[k, 1], path[k, 2] = x, y, z
        rise = wp - last if k > 0 else 1.0
        collected = not usable or _arrived(carrier, wp, rise, potential, maps.bias_V)
        last = wp
        if collected:
            break
        per_r = er / r if r > 0.0 else 0.0
        vx, vy, vz, strength, slope = carrier_velocity(
            maps.coefficients, maps.fields_per_V_per_cm, carrier, per_r * x, per_r * y, ez
        )
        now = math.sqrt(vx * vx + vy * vy + vz * vz)
        if size > 0.0:
            size = cloud_after_step(
                size, now, speed, strength, slope, diffusion, repulsion, step_ns, k
            )
        speed = now
        if k == n - 1:
            break
        wx, wy, wz = vx, vy, vz
        if k > 0:
            vx, vy, vz = vx + ahead * (vx - ux), vy + ahead * (vy - uy), vz + ahead * (vz - uz)
        ux, uy, uz = wx, wy, wz
        x, y, z = _moved(maps, carrier, (x, y, z), (vx * step_ns, vy * step_ns, vz * step_ns))
        k += 1
    for later in range(k + 1, n):
        signal[later] += induced
    return k, collected, size, speed, sign * (last - first) - induced


@kernel(inline="always")
def _arrived(carrier: int, wp: float, rise: float, potential: float, bias_V: float) -> bool:
    """Whether a carrier is collected at a weighting potential, after its `rise` in a step."""
    if carrier == HOLE:
        at_edge = wp >= _AT_CONTACT and rise < _CREEPING
        return 1.0 - wp < _COLLECTED or at_edge or potential <= 0.0
    return wp < _COLLECTED or potential >= bias_V


@kernel(inline="always")
def _moved(maps: DriftMaps, carrier: int, here: Place, step: Place) -> Place:
    """Place after a step. Charges slide along the passivated face, holes along the ditch."""
    x, y, z = here[0] + step[0], here[1] + step[1], max(here[2] + step[2], 0.0)
    p = math.sqrt(x * x + y * y) * maps.per_mm
    if carrier != HOLE or not in_ditch(maps, p, z * maps.per_mm):
        return x, y, z
    if not in_ditch(maps, p, here[2] * maps.per_mm):  # along its floor
        return x, y, here[2]
    return here[0], here[1], z
