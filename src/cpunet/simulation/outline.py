"""The outline of a crystal in (r, z): germanium, contacts, ditch, and what lies outside."""

from __future__ import annotations

import math
from collections import namedtuple
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from cpunet.kernels import kernel
from cpunet.simulation.geometry import BoolArray, Detector, FloatArray, RegionArray

POINT_CONTACT, LI_CONTACT, GERMANIUM, DITCH = 0, 1, 2, 5

_TOLERANCE = 1e-6  # mm; surfaces that coincide with a grid line do so despite rounding

# What of a detector makes its outline, under the same names: its lengths in mm, and more.
_LENGTHS = ("_length", "_radius", "_depth", "_thickness")
_VALUES = [name for name in Detector.model_fields if name.endswith(_LENGTHS)]
_VALUES += ["siggen_conventions", "taper_slopes", "ditch_walls", "steps"]
if TYPE_CHECKING:
    Outline: TypeAlias = Detector
else:
    Outline = namedtuple("Outline", _VALUES)


def outline_of(detector: Detector) -> Outline:
    """Outline of a detector, in the form that compiled loops take."""
    made: Any = Outline
    return cast("Outline", made(*(getattr(detector, name) for name in _VALUES)))


def places(detector: Detector, r: ArrayLike, z: ArrayLike) -> tuple[RegionArray, BoolArray]:
    """`Detector.region` and `Detector.inside` at places of a detector."""
    r, z = np.broadcast_arrays(np.asarray(r, float), np.asarray(z, float))
    values = np.empty((2, r.size), np.int8)
    _fill(outline_of(detector), r.flatten(), z.flatten(), values)
    return values[0].reshape(r.shape), values[1].reshape(r.shape).astype(np.bool_)


@kernel(error_model="numpy")
def _fill(outline: Outline, r: FloatArray, z: FloatArray, values: RegionArray) -> None:
    """Region of each place, and 1 if it lies inside."""
    region, inside = values
    radius, length = outline.point_contact_radius, outline.point_contact_length
    li = outline.li_thickness + _TOLERANCE
    for i in range(len(r)):
        inside[i] = in_germanium(outline, r[i], 0.0, z[i], -_TOLERANCE)
        if r[i] <= radius + _TOLERANCE and z[i] <= length + _TOLERANCE:
            region[i] = POINT_CONTACT
        elif not _within(outline, r[i], z[i], li, -_TOLERANCE):
            region[i] = LI_CONTACT
        else:
            region[i] = DITCH if _in_ditch(outline, r[i], z[i], _TOLERANCE) else GERMANIUM


@kernel(error_model="numpy")
def in_germanium(outline: Outline, x: float, y: float, z: float, shift: float) -> bool:
    """Whether a point lies in germanium, including the lithium layer, moved in by `shift`."""
    r = math.sqrt(x * x + y * y)
    return _within(outline, r, z, shift, shift) and not _in_ditch(outline, r, z, shift)


@kernel(error_model="numpy")
def _in_ditch(outline: Outline, r: float, z: float, margin: float) -> bool:
    """Whether a point lies in the ditch with its walls moved outwards by `margin`."""
    inner, outer, depth = outline.ditch_walls
    return depth > 0.0 and inner - margin <= r <= outer + margin and z <= depth + margin


@kernel(error_model="numpy")
def _within(outline: Outline, r: float, z: float, shift: float, face: float) -> bool:
    """Whether a point lies in the crystal or ditch, lithium faces moved in by `shift`.

    `face` is the height of the passivated face.
    """
    wrapped = 0.0 < outline.wrap_around_radius < r
    below_top = outline.crystal_length - z
    if not (shift if wrapped else face) < z < outline.crystal_length - shift:
        return False
    # the outer wall at this height
    outer_slope, inner_slope, bottom_slope = outline.taper_slopes
    wall = outline.crystal_radius - shift
    beyond = outline.crystal_length - outline.top_cylinder_length - z
    wall -= _step(outline.steps[0], beyond, 0.0, shift)
    beyond = z - outline.bottom_cylinder_length
    wall -= _step(outline.steps[1], beyond, outline.bottom_transition_length, shift)
    if outline.outer_taper_length > 0.0:
        into = z - (outline.crystal_length - outline.outer_taper_length)
        wall -= _taper(outline, into, outer_slope, shift)
    if outline.bottom_taper_length > 0.0:
        wall -= _taper(outline, outline.bottom_taper_length - z, bottom_slope, shift)
    if not r < wall:
        return False
    # groove and bore, with their walls moved outwards
    groove, radius = outline.top_groove_depth, outline.top_groove_radius
    if groove > 0.0 and below_top <= groove + shift and r <= radius + shift:
        return False
    if outline.bore_length > 0.0 and below_top <= outline.bore_length + shift:
        radius, bullet = outline.bore_radius + shift, outline.bore_bullet_radius
        if outline.inner_taper_length > 0.0:
            into = outline.inner_taper_length - below_top
            radius += _taper(outline, into, inner_slope, shift)
        across = r - (outline.bore_radius - bullet)
        along = below_top - outline.bore_length + bullet
        corner = across > 0.0 and along > 0.0
        rounded = corner and math.sqrt(across * across + along * along) > bullet + shift
        if r <= radius and not rounded:
            return False
    # rounded edges, `along` the axis into them
    for at_top in (True, False):
        bullet = outline.top_bullet_radius if at_top else outline.bottom_bullet_radius
        along = z - outline.crystal_length + bullet if at_top else bullet - z
        across = r - (outline.crystal_radius - bullet)
        corner = bullet > shift and across > 0.0 and along > 0.0
        if corner and math.sqrt(across * across + along * along) >= bullet - shift:
            return False
    return True


@kernel(error_model="numpy")
def _step(depth: float, beyond: float, length: float, shift: float) -> float:
    """Reduction in radius by a narrower end, `beyond` it, of walls moved in by `shift`."""
    if length == 0.0:  # its lithium, moved along the axis, lies in the wider part
        return 0.0 if beyond > shift else depth
    slope = depth / length
    extra = shift * (math.sqrt(1.0 + slope * slope) - 1.0)
    return min(max(depth - slope * beyond + extra, 0.0), depth)


@kernel(error_model="numpy")
def _taper(outline: Outline, into: float, slope: float, shift: float) -> float:
    """Reduction in radius by a taper, `into` it, of a wall moved in by `shift`."""
    if outline.siggen_conventions:  # the taper's start is moved down with the top
        extra = shift * slope
    else:  # the taper itself is moved along its normal
        extra = shift * (math.sqrt(1.0 + slope * slope) - 1.0)
    return max(into * slope + extra, 0.0)
