"""The detector: crystal, contacts, impurities and bias, all validated.

Cylindrical coordinates have their axis at r = 0. z = 0 is the face with the point contact
(p+). A bore, if any, opens at z = ``crystal_length``.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from cpunet.settings import Config, Millimetres

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
RegionArray = npt.NDArray[np.int8]
Angle = Annotated[float, Field(ge=0, lt=90)]
_Size = Annotated[float, Field(gt=0, le=1000)]  # mm
_Length = Annotated[float, Field(ge=-1e6, le=1e6)]  # mm; of an exponential, either sign
_Density = Annotated[float, Field(ge=-1e4, le=1e4)]

FIELDGEN_HALF_STEP_MM = 0.05
"""fieldgen's ditch includes the nodes on its walls: half a step more of its usual grid."""


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
        length, radius, li = self.crystal_length, self.crystal_radius, self.li_thickness
        outer, inner, bottom = self.taper_slopes
        steps, contact = self.steps, self.point_contact_radius
        wrap, ditch, bore = self.wrap_around_radius, self.ditch_depth, self.bore_length
        groove = self.top_groove_radius if self.top_groove_depth else 0.0
        mouth = max(self.bore_radius + self.inner_taper_length * inner, groove)
        top = radius - self.outer_taper_length * outer - steps[0]
        base = radius - self.bottom_taper_length * bottom - steps[1]
        edge = max(li, self.bottom_bullet_radius)
        ends = self.top_cylinder_length, self.bottom_cylinder_length
        rounded = self.top_bullet_radius, self.bottom_bullet_radius
        tapers = self.outer_taper_length, self.bottom_taper_length
        deep = "bore_length (with li_thickness)" if bore else "li_thickness"
        z = np.linspace(0, length, 101)
        with np.errstate(over="ignore", invalid="ignore"):
            impurity = self.impurity_1e10_per_cm3(np.array([[0.0], [radius]]), z)
        rivals = (
            ("top_bullet_radius", "top_cylinder_length"),
            ("bottom_bullet_radius", "bottom_cylinder_length"),
            ("bottom_bullet_radius", "bottom_transition_length"),
            ("top_bullet_radius", "outer_taper_length"),
            ("bottom_bullet_radius", "bottom_taper_length"),
        )
        pairs = (
            ("bore_length", "bore_radius"),
            ("ditch_depth", "ditch_thickness"),
            ("impurity_exponential_1e10_per_cm3", "impurity_exponential_length_mm"),
        )
        problems = {
            f"{a} and {b} cannot both be given": getattr(self, a) and getattr(self, b)
            for a, b in rivals
        }
        problems |= {
            f"{a} and {b} must both be given, or both be 0": (
                bool(getattr(self, a)) != bool(getattr(self, b))
            )
            for a, b in pairs
        }
        problems |= {
            f"{end}_cylinder_radius must be above 0 and at most crystal_radius": not (
                0 <= step < radius
            )
            for end, step in zip(("top", "bottom"), steps, strict=True)
        }
        problems |= {
            "top_groove_depth needs a top_groove_radius": bool(
                self.top_groove_depth and not groove
            ),
            "li_thickness leaves nothing of the crystal": 2 * li >= min(length, radius),
            "outer_taper_length and bottom_taper_length exceed crystal_length": (
                sum(tapers) > length
            ),
            "crystal_radius ends, with bottom_taper_length, inside a contact on z = 0": (
                base <= max(wrap, contact)
            ),
            f"{deep} reaches the point contact (point_contact_length)": (
                bore + 2 * li + self.point_contact_length >= length
            ),
            "inner_taper_length exceeds bore_length": self.inner_taper_length > bore,
            "bore_bullet_radius exceeds bore_radius or bore_length": (
                self.bore_bullet_radius > min(self.bore_radius, bore)
            ),
            "outer_taper_length or inner_taper_length leaves no germanium at the top": (
                top - mouth <= 2 * li
            ),
            "top_bullet_radius and bottom_bullet_radius exceed the crystal": (
                sum(rounded) > min(length, radius)
            ),
            "point_contact_radius meets the ditch (wrap_around_radius - ditch_thickness)": (
                0 < wrap < contact + self.ditch_thickness
            ),
            "ditch_depth needs a wrap_around_radius, its outer radius": wrap == 0 < ditch,
            "wrap_around_radius reaches the outer wall (crystal_radius, li_thickness)": (
                wrap >= radius - edge
            ),
            "point_contact_radius reaches the lithium of the outer wall (li_thickness)": (
                contact >= base - edge
            ),
            "ditch_depth reaches the bore (bore_length) or the top": (
                ditch + max(bore, self.top_groove_depth) + li >= length
            ),
            "bottom_cylinder_length and top_cylinder_length exceed crystal_length": (
                sum(ends) + self.bottom_transition_length > length
            ),
            "grid_mm does not resolve point_contact_radius; at most half of it": (
                self.grid_mm > contact / 2
            ),
            "impurity_… is not finite; correct impurity_exponential_length_mm": (
                not np.isfinite(impurity).all()
            ),
            "impurity_… is positive (n-type) somewhere in the crystal; p-type is negative": (
                impurity.max() > 0
            ),
        }
        if problem := next((text for text, wrong in problems.items() if wrong), ""):
            raise ValueError(problem)
        return self

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
        axial = (
            self.impurity_z0_1e10_per_cm3
            + self.impurity_gradient_1e10_per_cm4 * z / 10
            + self.impurity_quadratic_1e10_per_cm3
            * (1 - (2 * z / self.crystal_length - 1) ** 2)
        )
        if length_mm := self.impurity_exponential_length_mm:
            axial = axial + self.impurity_exponential_1e10_per_cm3 * np.exp(-z / length_mm)
        radial = (r / self.crystal_radius) ** self.impurity_radial_power
        scaled = axial * (1 + (self.impurity_radial_mult - 1) * radial)
        total = scaled + self.impurity_radial_add_1e10_per_cm3 * radial
        tilt = self.impurity_tilt_1e10_per_cm4 * self.per_tilt_cm(z)
        return np.asarray(self.impurity_scale * total + tilt)

    def per_tilt_cm(self, z: npt.ArrayLike) -> FloatArray:
        """Profile of a unit tilt at `z` in mm: z - L/2 in cm."""
        return (np.asarray(z, float) - self.crystal_length / 2) / 10

    def inside(self, r: npt.ArrayLike, z: npt.ArrayLike) -> BoolArray:
        """Whether `r`, `z` (mm) lie in germanium, including lithium layer and surfaces.

        Examples
        --------
        >>> from cpunet.simulation.geometry_readers import read_detector
        >>> read_detector("icpc").inside([0, 0, 12, 40], [10, 90, 1, 50])
        array([ True, False, False,  True])
        """
        from cpunet.simulation import outline  # compiled, which few users of a detector need

        return outline.insides(self, r, z)

    def active(self, r: npt.ArrayLike, z: npt.ArrayLike) -> BoolArray:
        """Whether `r`, `z` (mm) lie in germanium with a field: no contact, no ditch.

        Examples
        --------
        >>> from cpunet.simulation.geometry_readers import read_detector
        >>> read_detector("icpc").active([0, 0, 12, 40], [10, 1, 1, 50])
        array([ True, False, False, False])
        """
        from cpunet.simulation import outline

        return np.asarray(outline.regions(self, r, z) == outline.GERMANIUM)

    def region(self, r: npt.ArrayLike, z: npt.ArrayLike) -> RegionArray:
        """Region at `r`, `z` (mm): 0 point contact, 1 lithium or outside, 2 germanium, 5 ditch.

        Surfaces belong to the contacts and to the ditch.
        """
        from cpunet.simulation import outline

        return outline.regions(self, r, z)

    def fingerprint(self, exclude: Iterable[str] = ("name",)) -> str:
        """Hash of all values except those in `exclude`. Equal detectors have equal hashes."""
        values = self.model_dump(mode="json", exclude=set(exclude))
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:24]
