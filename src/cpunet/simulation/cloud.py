"""The charge cloud: its growth on the way of the holes, and what it does to the pulse.

The cloud is a Gaussian whose width follows the holes' path; the pulse of a point charge
is smeared by the time the cloud needs to pass into the contact.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel

FloatArray = npt.NDArray[np.float64]

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
# siggen's rounded value, in all that is compared with it
_SIGGEN_FWHM_PER_SIGMA = 2.355
# 2.355**2 times 0.12 V mm/cm, rounded there
_SIGGEN_DIFFUSION = 0.67
_BOLTZMANN_V_PER_K = 8.617333e-5
_SMALLEST_FWHM_MM = 0.01
_MAX_REPULSION = 0.05
_CUT_FWHM = 2.0


def diffusion_constant(chosen: float | str, temperature_K: float) -> float:
    """Growth of FWHM**2 / 2 per ns in units of v/E: mm2/ns over (mm/ns)/(V/cm).

    ``chosen`` is D/(v/E) in V mm/cm, ``"temperature"`` (Einstein relation, kT/e) or
    ``"siggen"``; see `cpunet.simulation.settings.SimulationSettings`.
    """
    if chosen == "siggen":
        return _SIGGEN_DIFFUSION
    if chosen == "temperature":
        chosen = _BOLTZMANN_V_PER_K * temperature_K * 10.0
    return FWHM_PER_SIGMA**2 * float(chosen)


def repulsion_constant(energy_kev: float) -> float:
    """Siggen's self-repulsion constant K: ds/dt = K (dv/dE) / s**2 with s in mm.

    Energy per electron-hole pair 0.003 keV, relative permittivity 16.
    """
    charge = energy_kev / 0.003 / 6.241e18
    return charge * 0.67**3 * 9e13 / 16 * _SIGGEN_FWHM_PER_SIGMA**3


def starting_fwhm_mm(fwhm_mm: float, diffusion: bool) -> float:
    """Width of the cloud when it is set free; a growing one cannot start from zero."""
    return max(fwhm_mm, _SMALLEST_FWHM_MM) if diffusion else fwhm_mm


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
    """FWHM (mm) of the cloud after one step; it is stretched where the charges speed up.

    ds/dt = D/s + R with D the diffusion and R the repulsion; long strides of a small
    cloud are integrated as powers of s, since ds would overshoot.
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
        return math.sqrt(
            2.0 * d * step_ns + (size * size * (size + 3.0 * r * step_ns)) ** (2.0 / 3.0)
        )
    return size + growth * step_ns


@kernel(fastmath=True)
def smear_and_sample(
    signal: npt.NDArray[np.float64] | npt.NDArray[np.float32],
    per_sample: int,
    sigma: float,
    last: int,
    weight: float,
    out: FloatArray,
) -> None:
    """Add `weight` times the smeared, block-averaged signal to `out`.

    Parameters
    ----------
    signal
        Pulse of a point charge, one value per step; zero before the record.
    per_sample
        Steps per sample of `out`.
    sigma
        Standard deviation of the Gaussian, in steps.
    last
        Step from which on the signal keeps its value.
    """
    reach = 0 if sigma < 0.3 else int(_CUT_FWHM * FWHM_PER_SIGMA * sigma) + 1
    kernel = _gaussian_block(per_sample, sigma, reach)
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


@kernel
def _gaussian_block(per_sample: int, sigma: float, reach: int) -> FloatArray:
    """A Gaussian of `sigma` steps, cut at `reach`, summed over a block and normalised."""
    kernel = np.zeros(per_sample + 2 * reach)
    total = 0.0
    for d in range(-reach, reach + 1):
        height = math.exp(-0.5 * (d / sigma) ** 2) if d != 0 else 1.0
        total += height * per_sample
        for m in range(per_sample):
            kernel[d + reach + m] += height
    return kernel / total
