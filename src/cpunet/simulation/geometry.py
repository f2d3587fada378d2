"""The detector: crystal, contacts, impurities and bias, all validated.

Cylindrical coordinates have their axis at r = 0. z = 0 is the face with the point contact
(p+). A bore, if any, opens at z = ``crystal_length``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from cpunet.settings import Config, Millimetres

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
RegionArray = npt.NDArray[np.int8]
Angle = Annotated[float, Field(ge=0, lt=90)]
_Size = Annotated[float, Field(gt=0, le=1000)]  # mm
_Length = Annotated[float, Field(ge=-1e6, le=1e6)]  # mm; of an exponential, either sign
_Density = Annotated[float, Field(ge=-1e4, le=1e4)]

# fieldgen's ditch includes the nodes on its walls: half a step more of its usual grid
FIELDGEN_HALF_STEP_MM = 0.05


class Detector(Config):
    r"""A p-type detector with a point contact (ICPC, BEGe or PPC); lengths in mm.

    Features whose size is 0 are absent. Without a ``wrap_around_radius`` the lithium contact
    ends where the outer wall meets z = 0. ``taper_angle_deg`` applies to the outer taper and,
    unless ``inner_taper_angle_deg`` is given, to that of the bore. A cylinder at the top or at
    the bottom is narrower than the crystal; the bottom one widens to it over a transition. A
    groove at the top has the axis in its middle, as the bore. ``vacuum_gap`` is the distance of
    a grounded plane below z = 0.

    The net impurity in 1e10/cm3 is negative for p-type germanium. It is

    .. math:: N = s \left[N_a(z) \left(1 + (m - 1) (r/R)^p\right) + N_r (r/R)^p\right]
        + t\, (z - L/2),

    .. math:: N_a(z) = N_0 + g z + q \left[1 - (2z/L - 1)^2\right] + N_e e^{-z/\lambda},

    where :math:`s` is ``impurity_scale``, :math:`N_0` is ``impurity_z0``, :math:`g` the
    gradient, :math:`q` the quadratic and :math:`N_e`, :math:`\lambda` the exponential term,
    :math:`m`, :math:`N_r`, :math:`p` are ``radial_mult``, ``radial_add`` and ``radial_power``.
    The tilt :math:`t` adds to the gradient but not to the mean. Gradient and tilt are per cm
    of :math:`z`. ``measured_depletion_V`` (0 if unknown) can be used to determine the scale.

    ``siggen_conventions`` places the lithium boundary on tapers, the walls of the ditch
    (0.05 mm wider) and the charge in the ditch as fieldgen does on its grid of 0.1 mm, so that
    pulses agree with siggen's. Without it the geometry is exact; docs/simulation.md gives the
    difference. The surface charge lies on the germanium of z = 0; without the conventions also
    on the walls and the floor of the ditch.
    """

    name: str = ""
    crystal_length: _Size
    crystal_radius: _Size
    top_bullet_radius: Millimetres = 0.0
    bottom_bullet_radius: Millimetres = 0.0
    point_contact_length: Millimetres
    point_contact_radius: _Size
    wrap_around_radius: Millimetres = 0.0
    ditch_depth: Millimetres = 0.0
    ditch_thickness: Millimetres = 0.0
    bore_length: Millimetres = 0.0
    bore_radius: Millimetres = 0.0
    bore_bullet_radius: Millimetres = 0.0
    outer_taper_length: Millimetres = 0.0
    inner_taper_length: Millimetres = 0.0
    bottom_taper_length: Millimetres = 0.0
    top_cylinder_length: Millimetres = 0.0
    top_cylinder_radius: Millimetres = 0.0
    bottom_cylinder_length: Millimetres = 0.0
    bottom_cylinder_radius: Millimetres = 0.0
    bottom_transition_length: Millimetres = 0.0
    top_groove_depth: Millimetres = 0.0
    top_groove_radius: Millimetres = 0.0
    taper_angle_deg: Angle = 0.0
    inner_taper_angle_deg: Angle | None = None
    bottom_taper_angle_deg: Angle = 45.0
    li_thickness: Millimetres
    vacuum_gap: Millimetres = 0.0
    impurity_z0_1e10_per_cm3: _Density
    impurity_gradient_1e10_per_cm4: _Density = 0.0
    impurity_quadratic_1e10_per_cm3: _Density = 0.0
    impurity_exponential_1e10_per_cm3: _Density = 0.0
    impurity_exponential_length_mm: _Length = 0.0
    impurity_radial_add_1e10_per_cm3: _Density = 0.0
    impurity_radial_mult: Annotated[float, Field(ge=0, le=1000)] = 1.0
    impurity_radial_power: Annotated[float, Field(gt=0, le=100)] = 2.0
    impurity_scale: Annotated[float, Field(gt=0, le=1e4)] = 1.0
    impurity_tilt_1e10_per_cm4: Annotated[float, Field(ge=-10, le=10)] = 0.0
    surface_charge_1e10_per_cm2: _Density = 0.0
    bias_V: Annotated[float, Field(gt=0, le=20_000)]
    measured_depletion_V: Annotated[float, Field(ge=0, le=20_000)] = 0.0
    temperature_K: Annotated[float, Field(ge=40, le=120)]
    grid_mm: Annotated[float, Field(ge=0.02, le=1)] = 0.1
    siggen_conventions: bool = True

    @model_validator(mode="after")
    def _is_possible(self) -> Detector:
        for problem in chain(self._missing(), self._overlaps(), self._reaches()):
            raise ValueError(problem)
        return self

    def _missing(self) -> Iterator[str]:
        """Values that are missing, that exclude each other, or impurities of another kind."""
        for names in (
            ("top_bullet_radius", "top_cylinder_length"),
            ("bottom_bullet_radius", "bottom_cylinder_length"),
            ("bottom_bullet_radius", "bottom_transition_length"),
            ("top_bullet_radius", "outer_taper_length"),
            ("bottom_bullet_radius", "bottom_taper_length"),
        ):
            if all(getattr(self, name) for name in names):
                yield f"{' and '.join(names)} cannot both be given"
        for names in (
            ("bore_length", "bore_radius"),
            ("ditch_depth", "ditch_thickness"),
            ("impurity_exponential_1e10_per_cm3", "impurity_exponential_length_mm"),
        ):
            if len({getattr(self, name) != 0 for name in names}) > 1:
                yield f"{' and '.join(names)} must both be given, or both be 0"
        for end, step in zip(("top", "bottom"), self.steps, strict=True):
            if not 0 <= step < self.crystal_radius:
                yield f"{end}_cylinder_radius must be above 0 and at most crystal_radius"
        if self.top_groove_depth and not self.top_groove_radius:
            yield "top_groove_depth and top_groove_radius must both be given"
        if self.ditch_depth and not self.wrap_around_radius:
            yield "ditch_depth needs a wrap_around_radius, its outer radius"
        z = np.linspace(0, self.crystal_length, 101)
        with np.errstate(over="ignore", invalid="ignore"):
            impurity = self.impurity_1e10_per_cm3(np.array([[0.0], [self.crystal_radius]]), z)
        if not np.isfinite(impurity).all():
            yield "impurity_… is not finite; correct impurity_exponential_length_mm"
        if impurity.max() > 0:
            yield "impurity_… is positive (n-type) somewhere in the crystal; p-type is negative"

    def _overlaps(self) -> Iterator[str]:
        """Parts that do not fit into each other."""
        length, radius = self.crystal_length, self.crystal_radius
        if self.outer_taper_length + self.bottom_taper_length > length:
            yield "outer_taper_length and bottom_taper_length exceed crystal_length"
        if self.inner_taper_length > self.bore_length:
            yield "inner_taper_length exceeds bore_length"
        if self.bore_bullet_radius > min(self.bore_radius, self.bore_length):
            yield "bore_bullet_radius exceeds bore_radius or bore_length"
        if self.top_bullet_radius + self.bottom_bullet_radius > min(length, radius):
            yield "top_bullet_radius and bottom_bullet_radius exceed the crystal"
        ends = self.top_cylinder_length, self.bottom_cylinder_length
        if sum(ends) + self.bottom_transition_length > length:
            yield "bottom_cylinder_length and top_cylinder_length exceed crystal_length"
        if self.grid_mm > self.point_contact_radius / 2:
            yield "grid_mm does not resolve point_contact_radius; at most half of it"

    def _reaches(self) -> Iterator[str]:
        """Contacts, bore and ditch that reach each other or a surface."""
        length, radius, li = self.crystal_length, self.crystal_radius, self.li_thickness
        outer, inner, bottom = self.taper_slopes
        groove = self.top_groove_radius if self.top_groove_depth else 0.0
        mouth = max(self.bore_radius + self.inner_taper_length * inner, groove)
        top_radius = radius - self.outer_taper_length * outer - self.steps[0]
        bottom_radius = radius - self.bottom_taper_length * bottom - self.steps[1]
        wrap, contact = self.wrap_around_radius, self.point_contact_radius
        edge = max(li, self.bottom_bullet_radius)
        if bottom_radius <= max(wrap, contact):
            yield "crystal_radius ends, with bottom_taper_length, inside a contact on z = 0"
        if self.bore_length + 2 * li + self.point_contact_length >= length:
            which = "bore_length (with li_thickness)" if self.bore_length else "li_thickness"
            yield f"{which} reaches the point contact (point_contact_length)"
        if top_radius - mouth <= 2 * li:
            yield "outer_taper_length or inner_taper_length leaves no germanium at the top"
        if wrap and wrap - self.ditch_thickness < contact:
            yield "point_contact_radius meets the ditch (wrap_around_radius - ditch_thickness)"
        if wrap >= radius - edge:
            yield "wrap_around_radius reaches the outer wall (crystal_radius, li_thickness)"
        if contact >= bottom_radius - edge:
            yield "point_contact_radius reaches the lithium of the outer wall (li_thickness)"
        if self.ditch_depth + max(self.bore_length, self.top_groove_depth) + li >= length:
            yield "ditch_depth reaches the bore (bore_length) or the top"

    @property
    def taper_slopes(self) -> tuple[float, float, float]:
        """Tangents of the angles of the outer, bore and bottom tapers."""
        outer, inner = self.taper_angle_deg, self.inner_taper_angle_deg
        angles = outer, outer if inner is None else inner, self.bottom_taper_angle_deg
        outer, inner, bottom = (math.tan(math.radians(angle)) for angle in angles)
        return outer, inner, bottom

    @property
    def steps(self) -> tuple[float, float]:
        """Radius of the crystal less those of its cylinders at top and bottom, in mm."""
        bottom_length = self.bottom_cylinder_length + self.bottom_transition_length
        top = self.crystal_radius - self.top_cylinder_radius
        bottom = self.crystal_radius - self.bottom_cylinder_radius
        return top if self.top_cylinder_length else 0.0, bottom if bottom_length else 0.0

    @property
    def ditch_walls(self) -> tuple[float, float, float]:
        """Inner and outer radius and depth of the ditch in mm."""
        extra = FIELDGEN_HALF_STEP_MM if self.siggen_conventions and self.ditch_depth else 0.0
        outer = self.wrap_around_radius
        return outer - self.ditch_thickness - extra, outer + extra, self.ditch_depth + extra

    def impurity_1e10_per_cm3(self, r: npt.ArrayLike, z: npt.ArrayLike) -> FloatArray:
        """Net impurity in 1e10/cm3 at `r`, `z` in mm; negative for p-type.

        See `Detector` for the equation.

        Examples
        --------
        >>> from cpunet.simulation.geometry_readers import read_detector
        >>> icpc = read_detector("icpc")
        >>> profile = icpc.impurity_1e10_per_cm3(0.0, [0.0, 10.0])  # 1 cm apart
        >>> bool(abs(np.diff(profile)[0] - icpc.impurity_gradient_1e10_per_cm4) < 1e-12)
        True
        """
        r, z = np.asarray(r, float), np.asarray(z, float)
        axial = self.impurity_z0_1e10_per_cm3 + self.impurity_gradient_1e10_per_cm4 * z / 10
        bent = 1 - (2 * z / self.crystal_length - 1) ** 2
        axial = axial + self.impurity_quadratic_1e10_per_cm3 * bent
        if length_mm := self.impurity_exponential_length_mm:
            axial = axial + self.impurity_exponential_1e10_per_cm3 * np.exp(-z / length_mm)
        radial = (r / self.crystal_radius) ** self.impurity_radial_power
        scaled = axial * (1 + (self.impurity_radial_mult - 1) * radial)
        total = scaled + self.impurity_radial_add_1e10_per_cm3 * radial
        tilt = self.impurity_tilt_1e10_per_cm4 * ((z - self.crystal_length / 2) / 10)
        return np.asarray(self.impurity_scale * total + tilt)

    def inside(self, r: npt.ArrayLike, z: npt.ArrayLike) -> BoolArray:
        """Whether `r`, `z` (mm) lie in germanium, including lithium layer and surfaces.

        Examples
        --------
        >>> from cpunet.simulation.geometry_readers import read_detector
        >>> read_detector("icpc").inside([0, 0, 12, 40], [10, 90, 1, 50])
        array([ True, False, False,  True])
        """
        from cpunet.simulation.outline import places  # compiled, which few users need

        return places(self, r, z)[1]

    def active(self, r: npt.ArrayLike, z: npt.ArrayLike) -> BoolArray:
        """Whether `r`, `z` (mm) lie in germanium with a field: no contact, no ditch.

        Examples
        --------
        >>> from cpunet.simulation.geometry_readers import read_detector
        >>> read_detector("icpc").active([0, 0, 12, 40], [10, 1, 1, 50])
        array([ True, False, False, False])
        """
        from cpunet.simulation.outline import GERMANIUM

        return np.asarray(self.region(r, z) == GERMANIUM)

    def region(self, r: npt.ArrayLike, z: npt.ArrayLike) -> RegionArray:
        """Region at `r`, `z` (mm): 0 point contact, 1 lithium or outside, 2 germanium, 5 ditch.

        Surfaces belong to the contacts and to the ditch.
        """
        from cpunet.simulation.outline import places

        return places(self, r, z)[0]
