"""The crystal as the transport needs it: germanium or vacuum at (r, z)."""

from __future__ import annotations

import math
from typing import NamedTuple

from cpunet.kernels import kernel
from cpunet.simulation.geometry import Detector


class CrystalShape(NamedTuple):
    """Outline of the germanium in mm, with z = 0 at the point-contact face.

    A plain tuple of numbers, as compiled code requires.
    """

    length: float
    radius: float
    bore_radius: float
    bore_end: float
    bore_bullet: float
    outer_taper_start: float
    outer_taper_slope: float
    inner_taper_start: float
    inner_taper_slope: float
    bottom_taper_end: float
    bottom_taper_slope: float
    top_bullet: float
    bottom_bullet: float
    ditch_inner: float
    ditch_outer: float
    ditch_depth: float
    top_step: float
    top_step_start: float
    bottom_step: float
    bottom_step_end: float
    bottom_transition: float
    groove_radius: float
    groove_start: float

    @classmethod
    def of(cls, detector: Detector) -> CrystalShape:
        """Outline of a detector including its lithium layer, as in `Detector.inside`."""
        length = detector.crystal_length
        outer, inner, bottom = (math.tan(angle) for angle in detector.taper_angles_rad)
        ditch_inner, ditch_outer, ditch_depth = detector.ditch_walls
        return cls(
            length=float(length),
            radius=float(detector.crystal_radius),
            bore_radius=float(detector.bore_radius),
            bore_end=float(length - detector.bore_length),
            bore_bullet=float(detector.bore_bullet_radius),
            outer_taper_start=float(length - detector.outer_taper_length),
            outer_taper_slope=outer,
            inner_taper_start=float(length - detector.inner_taper_length),
            inner_taper_slope=inner,
            bottom_taper_end=float(detector.bottom_taper_length),
            bottom_taper_slope=bottom,
            top_bullet=float(detector.top_bullet_radius),
            bottom_bullet=float(detector.bottom_bullet_radius),
            ditch_inner=float(ditch_inner),
            ditch_outer=float(ditch_outer),
            ditch_depth=float(ditch_depth),
            top_step=float(detector.narrower("top")),
            top_step_start=float(length - detector.top_cylinder_length),
            bottom_step=float(detector.narrower("bottom")),
            bottom_step_end=float(detector.bottom_cylinder_length),
            bottom_transition=float(detector.bottom_transition_length),
            groove_radius=float(detector.top_groove_radius),
            groove_start=float(length - detector.top_groove_depth),
        )


@kernel(error_model="numpy")
def in_germanium(shape: CrystalShape, x: float, y: float, z: float) -> bool:
    """Whether a point (mm) lies in germanium."""
    if z < 0.0 or z > shape.length:
        return False
    r = math.sqrt(x * x + y * y)
    if r > _outer_wall(shape, z):
        return False
    if z < shape.ditch_depth and shape.ditch_inner < r < shape.ditch_outer:
        return False
    return not _in_bore(shape, r, z)


@kernel(error_model="numpy")
def _outer_wall(shape: CrystalShape, z: float) -> float:
    """Radius of the crystal at a height. Tapers and bullets never share an end."""
    into_top = z - shape.length + shape.top_bullet
    into_bottom = shape.bottom_bullet - z
    wall = shape.radius
    wall -= max(z - shape.outer_taper_start, 0.0) * shape.outer_taper_slope
    wall -= max(shape.bottom_taper_end - z, 0.0) * shape.bottom_taper_slope
    if z > shape.top_step_start:
        wall -= shape.top_step
    beyond = z - shape.bottom_step_end
    if beyond < 0.0:
        wall -= shape.bottom_step
    elif beyond < shape.bottom_transition:
        wall -= shape.bottom_step * (1.0 - beyond / shape.bottom_transition)
    if into_top > 0.0:
        wall -= _rounded_off(shape.top_bullet, into_top)
    if into_bottom > 0.0:
        wall -= _rounded_off(shape.bottom_bullet, into_bottom)
    return wall


@kernel(error_model="numpy")
def _rounded_off(bullet: float, depth: float) -> float:
    """Reduction in radius by a quarter circle of radius `bullet`, `depth` after its start."""
    return bullet - math.sqrt(max(bullet * bullet - depth * depth, 0.0))


@kernel(error_model="numpy")
def _in_bore(shape: CrystalShape, r: float, z: float) -> bool:
    if z > shape.groove_start and r < shape.groove_radius:
        return True
    above = z - shape.bore_end
    if above <= 0.0:
        return False
    wall = shape.bore_radius
    wall += max(z - shape.inner_taper_start, 0.0) * shape.inner_taper_slope
    if above < shape.bore_bullet:
        # the end of the bore is rounded off with this radius
        end = shape.bore_radius - _rounded_off(shape.bore_bullet, shape.bore_bullet - above)
        wall = min(wall, end)
    return r < wall


@kernel(error_model="numpy")
def way_to_cylinder(
    radius: float, length: float, x: float, y: float, z: float, u: float, v: float, w: float
) -> float:
    """Distance in mm from a point above the crystal to its enclosing cylinder; -1 if missed."""
    if w >= 0.0:
        return -1.0
    t = (length - z) / w
    if (x + t * u) ** 2 + (y + t * v) ** 2 <= radius**2:
        return t
    a = u * u + v * v
    b = x * u + y * v
    c = x * x + y * y - radius**2
    inside_root = b * b - a * c
    if a == 0.0 or inside_root <= 0.0:
        return -1.0
    t = (-b - math.sqrt(inside_root)) / a
    height = z + t * w
    return t if t > 0.0 and 0.0 <= height <= length else -1.0
