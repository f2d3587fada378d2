"""The crystal as the transport sees it: germanium or vacuum at (r, z)."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numba


class CrystalDimensions(Protocol):
    """What the transport needs to know of a detector; lengths in mm."""

    @property
    def crystal_length(self) -> float: ...
    @property
    def crystal_radius(self) -> float: ...
    @property
    def bore_length(self) -> float: ...
    @property
    def bore_radius(self) -> float: ...
    @property
    def bore_bullet_radius(self) -> float: ...
    @property
    def outer_taper_length(self) -> float: ...
    @property
    def inner_taper_length(self) -> float: ...
    @property
    def taper_angle_deg(self) -> float: ...
    @property
    def wrap_around_radius(self) -> float: ...
    @property
    def ditch_depth(self) -> float: ...
    @property
    def ditch_thickness(self) -> float: ...


class CrystalShape(NamedTuple):
    """Outline of the germanium in mm, z = 0 at the point-contact face.

    A plain tuple of numbers, so that compiled code can take it.
    """

    length: float
    radius: float
    bore_radius: float
    bore_end: float
    bullet_radius: float
    outer_taper_start: float
    inner_taper_start: float
    taper_slope: float
    ditch_inner: float
    ditch_outer: float
    ditch_depth: float

    @classmethod
    def of(cls, detector: CrystalDimensions) -> CrystalShape:
        """The outline of a detector, Li layer included; other bullets are left out."""
        length = detector.crystal_length
        return cls(
            length=float(length),
            radius=float(detector.crystal_radius),
            bore_radius=float(detector.bore_radius),
            bore_end=float(length - detector.bore_length),
            bullet_radius=float(min(detector.bore_bullet_radius, detector.bore_radius)),
            outer_taper_start=float(length - detector.outer_taper_length),
            inner_taper_start=float(length - detector.inner_taper_length),
            taper_slope=math.tan(math.radians(detector.taper_angle_deg)),
            ditch_inner=float(detector.wrap_around_radius - detector.ditch_thickness),
            ditch_outer=float(detector.wrap_around_radius),
            ditch_depth=float(detector.ditch_depth),
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def in_germanium(shape: CrystalShape, x: float, y: float, z: float) -> bool:
    """Whether a point (mm) lies in germanium."""
    if z < 0.0 or z > shape.length:
        return False
    r = math.sqrt(x * x + y * y)
    if r > shape.radius - max(z - shape.outer_taper_start, 0.0) * shape.taper_slope:
        return False
    if z < shape.ditch_depth and shape.ditch_inner < r < shape.ditch_outer:
        return False
    return not _in_bore(shape, r, z)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _in_bore(shape: CrystalShape, r: float, z: float) -> bool:
    above = z - shape.bore_end
    if above <= 0.0:
        return False
    wall = shape.bore_radius + max(z - shape.inner_taper_start, 0.0) * shape.taper_slope
    if above < shape.bullet_radius:
        # the end of the bore is rounded off with this radius
        missing = shape.bullet_radius - above
        wall += math.sqrt(shape.bullet_radius**2 - missing**2) - shape.bullet_radius
    return r < wall


@numba.njit(cache=True, nogil=True, error_model="numpy")
def way_to_cylinder(
    radius: float, length: float, x: float, y: float, z: float, u: float, v: float, w: float
) -> float:
    """Distance in mm from a point above the crystal to the cylinder around it; -1: missed."""
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
