r"""Drift velocity of electrons and holes in cubic germanium.

Speeds measured along three crystal axes at 77 K are scaled to the crystal temperature. The
anisotropic velocity for any direction of the field is the gradient, with respect to the
field, of the integral of the speed over the field strength,

.. math:: \mathbf{v}(\mathbf{E}) = \pm \nabla_E \int_0^{|\mathbf{E}|}
    v(E' \hat{\mathbf{n}})\, dE', \qquad \hat{\mathbf{n}} = \mathbf{E} / |\mathbf{E}|.
"""

from __future__ import annotations

import math
from importlib.resources import files
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import cumulative_trapezoid

from cpunet.kernels import kernel

FloatArray = npt.NDArray[np.float64]

ELECTRON, HOLE = 0, 1

# Columns of `VelocityTable.coefficients`.
A, B, C, B_MEAN, C_MEAN, V100 = range(6)

_TABLE_K = 77.0
_RANGE_K = (40.0, 120.0)
# mu0 = mobility * T**power (cm2/Vs), vs = speed * sqrt(tanh(theta / 2 T)) (cm/s):
# Omar and Reggiani, Solid-State Electronics 30 (1987) 1351, values of Radford (2015).
_MOBILITY = (5.66e7, 1.63e9)
_POWER = (-1.680, -2.398)
_SPEED = (1.3e7, 1.2e7)
_THETA_K = 200.0
# V/cm: the low-field factor applies below the first, the high-field factor above the second
_LOW_FIELD, _HIGH_FIELD = 250.0, 1000.0

# Speed factors at low and high fields, of electrons and of holes.
VelocityFactors = tuple[tuple[float, float], tuple[float, float]]
AS_MEASURED: VelocityFactors = ((1.0, 1.0), (1.0, 1.0))


class VelocityTable(NamedTuple):
    """Anisotropy coefficients at equidistant field strengths, interpolated linearly.

    ``coefficients`` has shape ``(2 carriers, n fields, 6)`` in mm/ns: a, b, c, the means of
    b and c over fields from 0 upwards, and the speed along <100>.
    """

    coefficients: FloatArray
    fields_per_V_per_cm: float


def measured_table() -> FloatArray:
    """Speeds at 77 K: field in V/cm, then e100, e110, e111, h100, h110, h111 in mm/ns."""
    source = files("cpunet.simulation").joinpath("drift_velocity.csv")
    with source.open(encoding="utf-8") as lines:
        return np.loadtxt(lines, delimiter=",", comments=("#", "field"))


def velocity_table(
    temperature_K: float, factors: VelocityFactors = AS_MEASURED
) -> VelocityTable:
    r"""Anisotropy coefficients at a crystal temperature.

    The speeds at 77 K along <100>, <110> and <111> are multiplied by :math:`f(T)/f(77)` with

    .. math:: f = \frac{v_s x}{\sqrt{1 + x^2}}, \qquad x = \frac{\mu_0 E}{v_s}, \qquad
        v_s = B \sqrt{\tanh\frac{\theta}{2T}}, \qquad \mu_0 = A T^p,

    and combined into the coefficients of `carrier_velocity`,

    .. math:: a = \frac{v_{100}}{2} - 4 v_{110} + \frac{9 v_{111}}{2}, \quad
        b = -\frac{5 v_{100}}{2} + 16 v_{110} - \frac{27 v_{111}}{2}, \quad
        c = 3 v_{100} - 12 v_{110} + 9 v_{111}.

    Parameters
    ----------
    temperature_K
        Crystal temperature in K. It is limited to 40-120 K, the range of the model.
    factors
        Speed factors common to all axes, see `velocity_factor`.

    References
    ----------
    M. A. Omar and L. Reggiani, Solid-State Electronics 30 (1987) 1351, with the values of
    D. C. Radford (2015).

    Examples
    --------
    >>> table = velocity_table(90.0)
    >>> round(carrier_velocity(*table, HOLE, 1000.0, 0.0, 0.0)[0], 3)
    0.081
    """
    measured = measured_table()
    field = measured[:, 0]
    step = float(np.gcd.reduce(np.round(field).astype(np.int64)))
    grid = np.arange(round(field[-1] / step) + 1) * step
    low, high = _RANGE_K
    within = min(max(temperature_K, low), high)
    tables = []
    for carrier in (ELECTRON, HOLE):
        now, then = (_speed_model(carrier, field, kelvin) for kelvin in (within, _TABLE_K))
        factor = np.divide(now, then, out=np.ones_like(field), where=then > 0)
        factor = factor * velocity_factor(field, *factors[carrier])
        v100, v110, v111 = (measured[:, 1 + 3 * carrier : 4 + 3 * carrier] * factor[:, None]).T
        a = v100 / 2 - 4 * v110 + 4.5 * v111
        b = -2.5 * v100 + 16 * v110 - 13.5 * v111
        c = 3 * v100 - 12 * v110 + 9 * v111
        columns = (a, b, c, _running_mean(field, b), _running_mean(field, c), v100)
        tables.append(np.stack([np.interp(grid, field, column) for column in columns], 1))
    return VelocityTable(np.ascontiguousarray(tables), 1 / step)


def velocity_factor(field_V_per_cm: npt.ArrayLike, low: float, high: float) -> FloatArray:
    r"""Speed factor: `low` up to 250 V/cm, `high` from 1000 V/cm.

    .. math:: f = f_l + (f_h - f_l)\, x^2 (3 - 2x), \qquad
        x = \frac{\ln(E / 250\ \mathrm{V/cm})}{\ln 4} \in [0, 1]

    Examples
    --------
    >>> velocity_factor([100, 500, 2000], 0.9, 1.1).round(3)
    array([0.9, 1. , 1.1])
    """
    field = np.clip(np.asarray(field_V_per_cm, np.float64), _LOW_FIELD, _HIGH_FIELD)
    x = np.log(field / _LOW_FIELD) / math.log(_HIGH_FIELD / _LOW_FIELD)
    return np.asarray(low + (high - low) * x * x * (3 - 2 * x), np.float64)


def _speed_model(carrier: int, field: FloatArray, temperature_K: float) -> FloatArray:
    saturation = _SPEED[carrier] * math.sqrt(math.tanh(_THETA_K / (2 * temperature_K)))
    x = field * _MOBILITY[carrier] * temperature_K ** _POWER[carrier] / saturation
    return np.asarray(saturation * x / np.sqrt(1 + x**2), dtype=np.float64)


def _running_mean(field: FloatArray, values: FloatArray) -> FloatArray:
    """Mean of `values` over fields from 0 to each field, by the trapezoidal rule."""
    integral = cumulative_trapezoid(values, field, initial=0)
    mean: FloatArray = np.divide(integral, field, out=values.copy(), where=field > 0)
    return mean


@kernel(inline="always")
def carrier_velocity(
    coefficients: FloatArray, per_field: float, carrier: int, ex: float, ey: float, ez: float
) -> tuple[float, float, float, float, float, float]:
    r"""Velocity (mm/ns), field strength (V/cm), <100> speed and its slope of one charge.

    With the direction :math:`n_i = E_i/|E|` of the field, :math:`S_k = \sum_i n_i^k` and the
    coefficients :math:`a`, :math:`b`, :math:`c` of `velocity_table`,

    .. math:: v_i = \pm n_i \left[a + b S_4 + c S_6 + 4 \bar{b} (n_i^2 - S_4)
        + 6 \bar{c} (n_i^4 - S_6)\right], \qquad \bar{b} = \frac{1}{E} \int_0^E b\, dE',

    positive for holes and negative for electrons. The <100> axes are x, y and z. Beyond the
    last field of the table, its last interval is extrapolated linearly.

    Examples
    --------
    Along <100> the speed is that of the table.

    >>> row = measured_table()[8]
    >>> velocity = carrier_velocity(*velocity_table(77.0), HOLE, row[0], 0.0, 0.0)
    >>> bool(abs(velocity[0] - row[4]) < 1e-12), velocity[1:3]
    (True, (0.0, 0.0))
    """
    strength = math.sqrt(ex * ex + ey * ey + ez * ez)
    if strength <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    nx, ny, nz = ex / strength, ey / strength, ez / strength
    position = strength * per_field
    row = min(int(position), coefficients.shape[1] - 2)
    part = position - row
    low, high = coefficients[carrier, row], coefficients[carrier, row + 1]
    a = low[A] + part * (high[A] - low[A])
    b = low[B] + part * (high[B] - low[B])
    c = low[C] + part * (high[C] - low[C])
    b_mean = 4 * (low[B_MEAN] + part * (high[B_MEAN] - low[B_MEAN]))
    c_mean = 6 * (low[C_MEAN] + part * (high[C_MEAN] - low[C_MEAN]))
    slope = (high[V100] - low[V100]) * per_field
    speed = low[V100] + part * (high[V100] - low[V100])
    x2, y2, z2 = nx * nx, ny * ny, nz * nz
    x4, y4, z4 = x2 * x2, y2 * y2, z2 * z2
    s4 = x4 + y4 + z4
    s6 = x4 * x2 + y4 * y2 + z4 * z2
    common = a + b * s4 + c * s6 - b_mean * s4 - c_mean * s6
    sign = 1.0 if carrier == HOLE else -1.0
    vx = sign * nx * (common + b_mean * x2 + c_mean * x4)
    vy = sign * ny * (common + b_mean * y2 + c_mean * y4)
    vz = sign * nz * (common + b_mean * z2 + c_mean * z4)
    return vx, vy, vz, strength, speed, slope
