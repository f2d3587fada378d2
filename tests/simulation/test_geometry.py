"""The detector's shape and what it refuses; shifts of it and of its physics."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from cpunet.errors import CpunetError
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import Shift, SimulationSettings

ICPC = read_detector("icpc")
CYLINDERS = {
    "top_cylinder_length": 20, "top_cylinder_radius": 33, "bottom_cylinder_length": 25,
    "bottom_cylinder_radius": 36, "bottom_transition_length": 6, "top_groove_depth": 9,
    "top_groove_radius": 19, "outer_taper_length": 0,
}  # fmt: skip
LONG = {"siggen_conventions": False, "outer_taper_length": 0}
TEN, TWENTY = math.radians(10), math.radians(20)
R, L, BORE = ICPC.crystal_radius, ICPC.crystal_length, ICPC.bore_radius
BORE_END = L - ICPC.bore_length + BORE
SLOPE = math.hypot(6, 4.45)  # of the transition, 6 mm along the axis
NO_BORE = dict.fromkeys(("bore_length", "bore_radius", "bore_bullet_radius"), 0)
NO_DITCH = dict.fromkeys(("wrap_around_radius", "ditch_depth", "ditch_thickness"), 0)


def changed(**values: object) -> Detector:
    return Detector.model_validate({**ICPC.model_dump(), **values})


def test_rounded_walls_follow_their_profiles() -> None:
    length, radius = ICPC.crystal_length, ICPC.crystal_radius
    z = np.linspace(0.05, length - 0.05, 700)
    plain = {"outer_taper_length": 0, "bore_length": 69.9, "bore_radius": 5, "grid_mm": 0.1}
    rounded = {"top_bullet_radius": 6, "bottom_bullet_radius": 9, "bore_bullet_radius": 3}
    detector = changed(**plain, **rounded)
    top, bottom, end = (np.clip(x, 0, None) for x in (z - length + 6, 9 - z, 29.1 - z))
    outer = radius - 15 + np.sqrt(36 - top**2) + np.sqrt(81 - bottom**2)
    bore = np.where(z > 26.1, 2 + np.sqrt(np.clip(9 - end**2, 0, None)), np.nan)
    clear = z > detector.ditch_depth + 0.1  # above the ditch
    for wall, inwards in ((outer, -1e-4), (bore, 1e-4)):
        at = clear & np.isfinite(wall)
        assert detector.inside(wall + inwards, z)[at].all()
        assert not detector.inside(wall - inwards, z)[at].any()


@pytest.mark.parametrize(("change", "place", "inwards"), [
    ({}, (R, 30.0), (-1, 0)),
    ({}, (5 * math.sin(0.7), BORE_END - 5 * math.cos(0.7)), (math.sin(0.7), -math.cos(0.7))),
    (LONG | {"outer_taper_length": 30}, (R - 15 * math.tan(TEN), L - 15),
     (-math.cos(TEN), -math.sin(TEN))),
    (LONG | {"inner_taper_length": 30}, (BORE + 15 * math.tan(TEN), L - 15),
     (math.cos(TEN), -math.sin(TEN))),
    (LONG | {"bottom_taper_length": 20, "bottom_taper_angle_deg": 20},
     (R - 10 * math.tan(TWENTY), 10), (-math.cos(TWENTY), math.sin(TWENTY))),
    (CYLINDERS, (33.0, 90.0), (-1, 0)),  # wall of the upper cylinder
    (CYLINDERS, (38.0, 76.0), (0, -1)),  # step below it
    (CYLINDERS, (36.0, 12.0), (-1, 0)),  # wall of the lower cylinder
    (CYLINDERS, (36 + 4.45 / 2, 28.0), (-6 / SLOPE, 4.45 / SLOPE)),
    (CYLINDERS, (19.0, 92.0), (1, 0)),  # wall of the groove
    (CYLINDERS, (12.0, 87.0), (0, -1)),  # its floor
])  # fmt: skip
def test_lithium_is_as_thick_as_said(change, place, inwards) -> None:
    detector = changed(**change)
    for depth, inside, active in ((-0.01, 0, 0), (0.01, 1, 0), (0.99, 1, 0), (1.01, 1, 1)):
        at = [x + depth * step for x, step in zip(place, inwards, strict=True)]
        assert (detector.inside(*at), detector.active(*at)) == (inside, active)


def test_lithium_of_fieldgen_is_thicker_on_a_taper() -> None:
    theirs = changed(siggen_conventions=True)
    z, tangent = 80.0, math.tan(math.radians(10))
    wall = ICPC.crystal_radius - (z - 61) * tangent
    assert not theirs.active(wall - (1 + tangent) + 0.01, z)
    assert theirs.active(wall - (1 + tangent) - 0.01, z)
    exact = changed(siggen_conventions=False)
    assert exact.active(wall - 1 / math.cos(math.radians(10)) - 0.01, z)


def test_the_ditch_is_no_germanium_on_any_grid() -> None:
    assert ICPC.inside([12.5, 12.5, 10.9], [1, 2.1, 1]).tolist() == [False, True, True]
    r, z = np.meshgrid(np.linspace(10, 15, 501), np.linspace(0, 3, 301))
    fine, coarse = changed(grid_mm=0.05), changed(grid_mm=0.5)
    np.testing.assert_array_equal(fine.region(r, z), coarse.region(r, z))


def test_impurities_follow_their_terms() -> None:
    assert ICPC.impurity_1e10_per_cm3(0, 50) == pytest.approx(-1.3)
    quadratic = changed(impurity_quadratic_1e10_per_cm3=-0.2)
    assert quadratic.impurity_1e10_per_cm3(0, 48) == pytest.approx(-1.8 + 0.48 - 0.2)
    radial = changed(impurity_radial_mult=1.5, impurity_radial_add_1e10_per_cm3=-0.1)
    r = ICPC.crystal_radius
    assert radial.impurity_1e10_per_cm3(r, 0) == pytest.approx(-1.8 * 1.5 - 0.1)


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"bore_length": 94.0}, "bore_length .* reaches the point contact"),
        (
            NO_BORE | {"point_contact_length": 94.5},
            "error, li_thickness reaches the point cont",
        ),
        (NO_DITCH | {"point_contact_radius": 39.6}, "point_contact_radius reaches the lithium"),
        ({"bore_bullet_radius": 6}, "bore_bullet_radius"),
        ({"point_contact_radius": 11.5}, "point_contact_radius"),
        ({"wrap_around_radius": 40}, "wrap_around_radius"),
        ({"wrap_around_radius": 0}, "ditch_depth"),
        ({"ditch_depth": 30}, "ditch_depth"),
        ({"li_thickness": 30}, "li_thickness"),
        ({"taper_angle_deg": 45}, "taper"),
        ({"inner_taper_length": 75}, "inner_taper_length"),
        ({"bottom_taper_length": 35}, "bottom_taper_length"),
        ({"top_bullet_radius": 2}, "top_bullet_radius"),
        ({"bottom_bullet_radius": 2, "bottom_taper_length": 2}, "bottom_bullet_radius"),
        ({"bottom_transition_length": 3}, "bottom_cylinder_radius must be above 0"),
        ({"top_groove_depth": 3}, "top_groove_radius"),
        (CYLINDERS | {"bottom_cylinder_length": 75}, "cylinder_length exceed crystal_length"),
        (CYLINDERS | {"top_groove_radius": 32}, "leaves no germanium at the top"),
        ({"impurity_gradient_1e10_per_cm4": 0.5}, "impurity"),
        ({"point_contact_radius": 0.15}, "grid_mm"),
        ({"crystal_length": -1}, "crystal_length"),
        ({"bias_V": float("nan")}, "bias_V"),
    ],
)
def test_impossible_detectors_are_refused(values: dict[str, float], key: str) -> None:
    with pytest.raises(ValidationError, match=key):
        changed(**values)


def test_every_key_changes_the_value_that_it_names() -> None:
    for key in Shift.model_fields:
        shift = Shift(**{key: 1.05 if key.endswith("factor") else 0.01})
        pairs = [(before, shift.applied(before)) for before in (ICPC, SimulationSettings())]
        (name,) = (n for a, b in pairs for n, value in a if value != getattr(b, n))
        assert key.startswith(name) or (key, name) == ("impurity_factor", "impurity_scale")


def test_files_and_single_keys(tmp_path: Path) -> None:
    file = tmp_path / "shift.yaml"
    file.write_text("temperature_K: 1\nself_repulsion: true\n")
    shift = Shift.of([str(file), "temperature_K=1.5"])
    assert shift == Shift(temperature_K=1.5, self_repulsion=1.0)


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ("temprature_K=1", "temprature_K: no such setting; did you mean temperature_K?"),
        ("temperature_K=.nan", "finite"),
        ("impurity_factor=0", "greater than 0"),
        ("diffusion_constant=cold", "diffusion_constant"),
        ("cloud_fwhm_mm=true", "cloud_fwhm_mm: Input should be a number, not true or false"),
        ("temperature_K=100", "shifted: temperature_K: Input should be less than or equal"),
        ("hole_trapping_per_us=-1", "hole_trapping_per_us"),
    ],
)
def test_bad_shifts_are_named(part: str, said: str) -> None:
    with pytest.raises(CpunetError, match=re.escape(said)):
        [Shift.of([part]).applied(to) for to in (ICPC, SimulationSettings())]
