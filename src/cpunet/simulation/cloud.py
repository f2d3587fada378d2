"""Growth of the charge cloud along the path of the holes, and its effect on the pulse.

The cloud is a Gaussian whose width evolves along the path of the holes. The pulse of a point
charge is convolved with a Gaussian as long as the cloud takes to enter the contact.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel

FloatArray = npt.NDArray[np.float64]

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
# siggen's rounded value, used in its formulas
_SIGGEN_FWHM_PER_SIGMA = 2.355
# 2.355**2 times 0.12 V mm/cm, as rounded in siggen
_SIGGEN_DIFFUSION = 0.67
_BOLTZMANN_V_PER_K = 8.617333e-5
SMALLEST_FWHM_MM = 0.01
"""Initial FWHM of a cloud that grows, at least."""
_MAX_REPULSION = 0.05
_CUT_FWHM = 2.0


def diffusion_constant(chosen: float | str, temperature_K: float) -> float:
    r"""Diffusion constant of the cloud in units of v/E: mm2/ns over (mm/ns)/(V/cm).

    The FWHM :math:`s` of a diffusing Gaussian cloud follows

    .. math:: \frac{ds^2}{dt} = 2\, D_s, \qquad D_s = 8 \ln 2 \cdot D, \qquad
        \frac{D}{v/E} = \frac{kT}{e} \quad \mathrm{(Einstein)},

    and the function returns :math:`D_s / (v/E)`.

    Parameters
    ----------
    chosen
        D/(v/E) in V mm/cm, ``"temperature"`` (Einstein relation, kT/e) or ``"siggen"``; see
        `cpunet.simulation.settings.SimulationSettings`.
    temperature_K
        Crystal temperature in K.

    Examples
    --------
    At 90 K, kT/e is 7.76 mV, or 0.0776 V mm/cm.

    >>> round(diffusion_constant("temperature", 90.0) / FWHM_PER_SIGMA**2, 4)
    0.0776
    """
    if chosen == "siggen":
        return _SIGGEN_DIFFUSION
    if chosen == "temperature":
        chosen = _BOLTZMANN_V_PER_K * temperature_K * 10.0
    return FWHM_PER_SIGMA**2 * float(chosen)


def repulsion_constant(energy_kev: float) -> float:
    r"""Self-repulsion constant :math:`K` of siggen.

    .. math:: \frac{ds}{dt} = \frac{K}{s^2} \frac{dv}{dE}

    with the FWHM :math:`s` in mm. :math:`K` is proportional to the charge of the cloud, with
    0.003 keV per electron-hole pair and a relative permittivity of 16.

    Parameters
    ----------
    energy_kev
        Energy deposit in keV.

    References
    ----------
    D. C. Radford, siggen.

    Examples
    --------
    >>> bool(repulsion_constant(2000.0) == 2 * repulsion_constant(1000.0))
    True
    """
    charge = energy_kev / 0.003 / 6.241e18
    return charge * 0.67**3 * 9e13 / 16 * _SIGGEN_FWHM_PER_SIGMA**3


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

    The cloud is stretched in proportion to the speed, then grows by diffusion and repulsion,

    .. math:: \frac{ds}{dt} = \frac{D}{s} + R.

    Large steps of a small cloud, which would overshoot, are integrated in powers of s,

    .. math:: s_{k+1}^2 = 2 D\, \Delta t + \left[s_k^2 (s_k + 3 R\, \Delta t)\right]^{2/3}.
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
    """Gaussian of `sigma` steps, truncated at `reach`, summed over a block and normalised."""
    kernel = np.zeros(per_sample + 2 * reach)
    total = 0.0
    for d in range(-reach, reach + 1):
        height = math.exp(-0.5 * (d / sigma) ** 2) if d != 0 else 1.0
        total += height * per_sample
        for m in range(per_sample):
            kernel[d + reach + m] += height
    return kernel / total
