r"""What drifts where: field maps and velocities in the form that compiled loops take.

**Maps.** Nodes inside a contact carry no field. The first layers of them are extrapolated from
the germanium, so the surface of a contact lies between nodes where the potential reaches that
of the contact. Maps coarser than 0.1 mm are refined by cubic splines, because bilinear
interpolation would flatten the weighting potential near the contact.

**Velocities** of electrons and holes in cubic germanium: speeds measured along three crystal
axes at 77 K are scaled to the crystal temperature. The anisotropic velocity for any direction
of the field is the gradient, with respect to the field, of the integral of the speed over the
field strength,

.. math:: \mathbf{v}(\mathbf{E}) = \pm \nabla_E \int_0^{|\mathbf{E}|}
    v(E' \hat{\mathbf{n}})\, dE', \qquad \hat{\mathbf{n}} = \mathbf{E} / |\mathbf{E}|.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import RectBivariateSpline

from cpunet.kernels import kernel
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.geometry import BoolArray, FloatArray
from cpunet.simulation.outline import DITCH
from cpunet.simulation.settings import SimulationSettings

ELECTRON, HOLE = 0, 1

# Columns of the coefficients of `velocity_table`.
A, B, C, B_MEAN, C_MEAN, V100 = range(6)

_TABLE_K = 77.0
# mu0 = mobility * T**power (cm2/Vs), vs = speed * sqrt(tanh(theta / 2 T)) (cm/s):
# Omar and Reggiani, Solid-State Electronics 30 (1987) 1351, values of Radford (2015).
_MOBILITY = (5.66e7, 1.63e9)
_POWER = (-1.680, -2.398)
_SPEED = (1.3e7, 1.2e7)
_THETA_K = 200.0
# V/cm: the low-field factor applies below the first, the high-field factor above the second
_LOW_FIELD, _HIGH_FIELD = 250.0, 1000.0
AS_MEASURED = SimulationSettings()  # without velocity factors


def velocity_table(
    temperature_K: float, settings: SimulationSettings = AS_MEASURED
) -> tuple[FloatArray, float]:
    r"""Anisotropy coefficients at equidistant field strengths, for a crystal temperature.

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
        Crystal temperature in K.
    settings
        Their velocity factors, common to all axes, are applied: :math:`f_l` up to 250 V/cm,
        :math:`f_h` from 1000 V/cm, and between these

        .. math:: f = f_l + (f_h - f_l)\, x^2 (3 - 2x), \qquad
            x = \frac{\ln(E / 250\ \mathrm{V/cm})}{\ln 4}.

    Returns
    -------
    coefficients
        Shape ``(2 carriers, n fields, 6)``, in mm/ns: a, b, c, the means of b and c over fields
        from 0 upwards, and the speed along <100>. They are interpolated linearly.
    per_field
        Number of rows per V/cm.

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
    # field in V/cm, then e100, e110, e111, h100, h110, h111 in mm/ns
    file = Path(__file__).with_name("drift_velocity.csv")
    measured = np.loadtxt(file, delimiter=",", comments=("#", "field"), encoding="utf-8")
    field = measured[:, 0]
    step = float(np.gcd.reduce(np.round(field).astype(np.int64)))
    grid = np.arange(round(field[-1] / step) + 1) * step
    tables = []
    for carrier, name in ((ELECTRON, "electron"), (HOLE, "hole")):
        speeds = []
        for kelvin in (temperature_K, _TABLE_K):
            saturation = _SPEED[carrier] * math.sqrt(math.tanh(_THETA_K / (2 * kelvin)))
            x = field * _MOBILITY[carrier] * kelvin ** _POWER[carrier] / saturation
            speeds.append(saturation * x / np.sqrt(1 + x**2))
        now, then = speeds
        factor = np.divide(now, then, out=np.ones_like(field), where=then > 0)
        low = getattr(settings, f"{name}_velocity_low_factor")
        high = getattr(settings, f"{name}_velocity_high_factor")
        x = np.log(np.clip(field, _LOW_FIELD, _HIGH_FIELD) / _LOW_FIELD)
        x /= math.log(_HIGH_FIELD / _LOW_FIELD)
        factor = factor * (low + (high - low) * x * x * (3 - 2 * x))
        v100, v110, v111 = (measured[:, 1 + 3 * carrier : 4 + 3 * carrier] * factor[:, None]).T
        a = v100 / 2 - 4 * v110 + 4.5 * v111
        b = -2.5 * v100 + 16 * v110 - 13.5 * v111
        c = 3 * v100 - 12 * v110 + 9 * v111
        means = []
        for values in (b, c):
            integral = cumulative_trapezoid(values, field, initial=0)
            means.append(np.divide(integral, field, out=values.copy(), where=field > 0))
        columns = (a, b, c, *means, v100)
        tables.append(np.stack([np.interp(grid, field, column) for column in columns], 1))
    return np.ascontiguousarray(tables), 1 / step


@kernel(inline="always")
def carrier_velocity(
    coefficients: FloatArray, per_field: float, carrier: int, ex: float, ey: float, ez: float
) -> tuple[float, float, float, float, float]:
    r"""Velocity (mm/ns) of a charge, field strength (V/cm), and slope of the speed along <100>.

    With the direction :math:`n_i = E_i/|E|` of the field, :math:`S_k = \sum_i n_i^k` and the
    coefficients :math:`a`, :math:`b`, :math:`c` of `velocity_table`,

    .. math:: v_i = \pm n_i \left[a + b S_4 + c S_6 + 4 \bar{b} (n_i^2 - S_4)
        + 6 \bar{c} (n_i^4 - S_6)\right], \qquad \bar{b} = \frac{1}{E} \int_0^E b\, dE',

    positive for holes and negative for electrons. The <100> axes are x, y and z. Beyond the
    last field of the table, its last interval is extrapolated linearly.
    """
    strength = math.sqrt(ex * ex + ey * ey + ez * ez)
    if strength <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
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
    x2, y2, z2 = nx * nx, ny * ny, nz * nz
    x4, y4, z4 = x2 * x2, y2 * y2, z2 * z2
    s4 = x4 + y4 + z4
    s6 = x4 * x2 + y4 * y2 + z4 * z2
    common = a + b * s4 + c * s6 - b_mean * s4 - c_mean * s6
    sign = 1.0 if carrier == HOLE else -1.0
    vx = sign * nx * (common + b_mean * x2 + c_mean * x4)
    vy = sign * ny * (common + b_mean * y2 + c_mean * y4)
    vz = sign * nz * (common + b_mean * z2 + c_mean * z4)
    return vx, vy, vz, strength, slope


# Columns of `DriftMaps.values`.
E_R, E_Z, WP, VOLTS = range(4)

# Maximum step of refined maps.
_FINE_MM = 0.1
# Extrapolated nodes used by the splines inside a contact and beyond a mirror plane.
_SPLINE_GHOSTS, _SPLINE_MIRROR = 8, 6


class DriftMaps(NamedTuple):
    """Field maps and velocities in the form the compiled loops take.

    ``values`` is (nr, nz, 4): field in r and z (V/cm), weighting potential, potential (V).
    ``usable`` (nr - 1, nz - 1) marks the cells in which a charge can drift, ``ditch`` the
    nodes of the ditch (nr, those up to its top). ``trapping_per_ns`` holds the trapping rates
    of electrons and holes.
    """

    values: FloatArray
    usable: BoolArray
    ditch: BoolArray
    per_mm: float
    bias_V: float
    coefficients: FloatArray
    fields_per_V_per_cm: float
    trapping_per_ns: FloatArray


def drift_maps(
    fields: FieldMaps, temperature_K: float, settings: SimulationSettings
) -> DriftMaps:
    """Prepare field maps for the drift: extrapolated into contacts, refined if coarse.

    Of the `settings`, only the velocity factors and trapping rates are used.
    """
    e_r, e_z, volts = fields.e_r_V_per_cm, fields.e_z_V_per_cm, fields.potential_V
    stacked = np.stack([e_r, e_z, fields.weighting_potential, volts], axis=-1).astype(float)
    # nothing drifts in the ditch, and the field is discontinuous at its walls
    ditch = np.asarray(fields.region) == DITCH
    with_field = np.isfinite(stacked).all(-1) & ~ditch & (stacked[..., :2] != 0).any(-1)
    bias = float(np.nanmax(stacked[..., VOLTS]))
    values, filled = with_ghost_nodes(np.where(with_field[..., None], stacked, 0.0), with_field)
    usable = _all_corners(filled) & ~_all_corners(~with_field)
    parts = math.ceil(fields.grid_mm / _FINE_MM - 1e-6)
    if parts > 1:
        for _ in range(_SPLINE_GHOSTS):
            values, filled = with_ghost_nodes(values, filled)
        # The axis is a mirror, as is z = 0 without a field across it: such fields are odd.
        n = _SPLINE_MIRROR
        odd_r, odd_z = np.ones(4), np.ones(4)
        odd_r[E_R] = odd_z[E_Z] = -1
        values = np.concatenate([values[n:0:-1] * odd_r, values])
        below = 0 if stacked[:, 0, E_Z].any() else n
        if below:
            values = np.concatenate([values[:, n:0:-1] * odd_z, values], axis=1)
        r, z = np.arange(values.shape[0]) - n, np.arange(values.shape[1]) - below
        fine_r, fine_z = (np.arange(nodes[-1] * parts + 1) / parts for nodes in (r, z))
        splines = [RectBivariateSpline(r, z, values[..., k], s=0) for k in range(4)]
        values = np.stack([spline(fine_r, fine_z) for spline in splines], axis=-1)
        fine = np.ones((parts, parts), np.bool_)
        # nodes at the corners of the cells of the ditch
        ditch = ~_all_corners(~np.pad(np.kron(_all_corners(ditch), fine), 1))
        usable = np.kron(usable, fine)
    coefficients, per_field = velocity_table(temperature_K, settings)
    per_us = settings.electron_trapping_per_us, settings.hole_trapping_per_us
    return DriftMaps(
        values=np.ascontiguousarray(values),
        usable=usable,
        ditch=np.ascontiguousarray(ditch[:, : ditch.any(0).argmin()]),
        per_mm=parts / fields.grid_mm,
        bias_V=bias,
        coefficients=coefficients,
        fields_per_V_per_cm=per_field,
        trapping_per_ns=np.array(per_us) / 1000,
    )


def _all_corners(nodes: BoolArray) -> BoolArray:
    """Cells (nr - 1, nz - 1) with all four corners in `nodes` (nr, nz)."""
    return np.asarray(nodes[:-1, :-1] & nodes[1:, :-1] & nodes[:-1, 1:] & nodes[1:, 1:])


def with_ghost_nodes(values: FloatArray, given: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Extrapolate linearly by a node along r and z, then around the corners.

    A node next to two given nodes in line becomes twice the nearer value minus the farther.

    Parameters
    ----------
    values
        Array of shape ``(nr, nz, ...)``.
    given
        Boolean array (nr, nz): nodes with a value.

    Examples
    --------
    >>> values, given = np.array([[1.0], [2.0], [0.0]]), np.array([[True], [True], [False]])
    >>> with_ghost_nodes(values, given)[0].ravel().tolist()
    [1.0, 2.0, 3.0]
    """
    nr, nz = given.shape
    for _ in range(2):
        total, ways, padded = np.zeros_like(values), np.zeros(given.shape), np.pad(given, 2)
        for dr, dz in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            nearer, farther = (
                padded[2 + n * dr : 2 + n * dr + nr, 2 + n * dz : 2 + n * dz + nz]
                for n in (1, 2)
            )
            i, j = np.nonzero(nearer & farther & ~given)
            total[i, j] += 2 * values[i + dr, j + dz] - values[i + 2 * dr, j + 2 * dz]
            ways[i, j] += 1
        new = np.nonzero(ways)
        filled = values.copy()
        filled[new] = (total[new].T / ways[new]).T
        values, given = filled, given | (ways > 0)
    return values, given


@kernel(inline="always")
def in_ditch(maps: DriftMaps, p: float, q: float) -> bool:
    """Whether a place, at r and z in steps of the maps, is nearest to a node of the ditch."""
    column, row = int(p + 0.5), int(q + 0.5)
    return row < maps.ditch.shape[1] and column < len(maps.ditch) and maps.ditch[column, row]


@kernel(inline="always")
def look_up(maps: DriftMaps, r: float, z: float) -> tuple[float, float, float, float, bool]:
    """Field in r and z (V/cm), weighting potential, potential (V); False outside."""
    p, q = r * maps.per_mm, z * maps.per_mm
    nr, nz = maps.usable.shape
    # before the conversion to an index, which overflows for what is far away or no number
    if not (0.0 <= p < nr and 0.0 <= q < nz):
        return 0.0, 0.0, 0.0, 0.0, False
    i, j = int(p), int(q)
    u, v = p - i, q - j
    if not maps.usable[i, j] or in_ditch(maps, p, q):
        return 0.0, 0.0, 0.0, 0.0, False
    w00, w10, w01, w11 = (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v
    m00, m10 = maps.values[i, j], maps.values[i + 1, j]
    m01, m11 = maps.values[i, j + 1], maps.values[i + 1, j + 1]
    er = w00 * m00[E_R] + w10 * m10[E_R] + w01 * m01[E_R] + w11 * m11[E_R]
    ez = w00 * m00[E_Z] + w10 * m10[E_Z] + w01 * m01[E_Z] + w11 * m11[E_Z]
    wp = w00 * m00[WP] + w10 * m10[WP] + w01 * m01[WP] + w11 * m11[WP]
    volts = w00 * m00[VOLTS] + w10 * m10[VOLTS] + w01 * m01[VOLTS] + w11 * m11[VOLTS]
    return er, ez, min(max(wp, 0.0), 1.0), volts, True


@kernel
def in_active_volume(maps: DriftMaps, x: float, y: float, z: float) -> bool:
    """Whether a charge released here drifts: germanium with a field, outside contacts."""
    _, _, _, potential, usable = look_up(maps, math.hypot(x, y), z)
    return usable and 0.0 < potential < maps.bias_V
