"""Detectors as siggen and LEGEND's metadata describe them, read by their own rules."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector

SIGGEN = """
xtal_length         80   # z length
xtal_radius         35
pc_length            2
pc_radius            3
wrap_around_radius  15
ditch_depth          2
ditch_thickness      3
hole_length         50
hole_radius          5
hole_bullet_radius   2
inner_taper_length  45
taper_angle          5
Li_thickness       1.0
impurity_z0       -1.0
impurity_gradient  0.02
xtal_HV           3500
xtal_temp           90
"""


def siggen(folder: Path, more: str = "", without: str = "") -> Detector:
    """The detector of the configuration, with lines added at its end or left out."""
    lines = [line for line in SIGGEN.splitlines() if not (without and line.startswith(without))]
    path = folder / "D.config"
    path.write_text("\n".join([*lines, more, ""]))
    return read_detector(path)


@pytest.mark.parametrize(
    ("more", "without", "field", "value"),
    [
        ("xtal_diam 70.5", "xtal_radius", "crystal_radius", 35.25),
        ("pc_diam 7", "pc_radius", "point_contact_radius", 3.5),
        ("hole_diam 9", "hole_radius", "bore_radius", 4.5),
        ("pc_radius 4", "", "point_contact_radius", 4),
        # lines that begin with a space are comments
        (" pc_radius 4\n\tpc_radius 5", "", "point_contact_radius", 3),
        # as far as the ditch, where a larger one ends, and one of 0 is meant
        ("pc_radius 14", "", "point_contact_radius", 12),
        ("pc_radius 0", "", "point_contact_radius", 12),
        ("hole_bullet_radius 6", "", "bore_bullet_radius", 5),
        ("inner_taper_length 60", "", "inner_taper_length", 50),
        ("hole_length_gap 32", "", "bore_length", 48),
        ("pc_offset_x 0\nhole_offset_y_top 0.0", "", "bore_radius", 5),
        # no ditch: a wrap-around as far as the wall, or further, is none
        ("wrap_around_radius 40", "ditch", "wrap_around_radius", 0),
    ],
)
def test_siggens_own_rules(tmp_path, more, without, field, value) -> None:
    assert getattr(siggen(tmp_path, more, without), field) == pytest.approx(value)


def test_widths_of_tapers_count_where_the_angle_is_0(tmp_path: Path) -> None:
    more = "taper_angle 0\nouter_taper_length 20\nouter_taper_width 4\ninner_taper_width 2"
    outer, inner, _ = siggen(tmp_path, more).taper_angles_rad
    assert (math.tan(outer), math.tan(inner)) == pytest.approx((4 / 20, 2 / 45))
    outer, inner, _ = siggen(tmp_path, more.replace("angle 0", "angle 5")).taper_angles_rad
    assert np.degrees([outer, inner]) == pytest.approx(5)
    # a width of one taper is not that of the other
    assert siggen(tmp_path, more.rpartition("\n")[0]).taper_angles_rad[1] == 0


def test_radial_terms_need_a_power(tmp_path: Path) -> None:
    radial = "impurity_radial_add -0.4\nimpurity_radial_mult 1.5"
    for more in (radial, f"{radial}\nimpurity_rpower 0"):
        assert siggen(tmp_path, more).impurity_1e10_per_cm3(35, 0) == pytest.approx(-1)
    found = siggen(tmp_path, f"{radial}\nimpurity_rpower 2").impurity_1e10_per_cm3([0, 35], 0)
    assert found == pytest.approx([-1, -1.5 - 0.4])


def test_what_was_cut_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "cpunet"):
        siggen(tmp_path, "pc_radius 14")
    (said,) = caplog.messages
    assert "pc_radius is 12 mm, as in siggen: at most wrap_around_radius - ditch_th" in said


def test_holes_beside_the_axis_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CpunetError, match="hole_offset_y_top is not 0; only axially symmetric"):
        siggen(tmp_path, "hole_offset_y_top 4")


DIODE: dict[str, Any] = {
    "name": "V99000A",
    "type": "icpc",
    "production": {
        "impcc": {
            "array": {"value_in_1e9e/cm3": [9.0, 9.0], "dist_from_contact_in_mm": [0.0, 30.0]}
        }
    },
    "geometry": {
        "height_in_mm": 80,
        "radius_in_mm": 35,
        "borehole": {"radius_in_mm": 5, "depth_in_mm": 55},
        "groove": {"depth_in_mm": 1, "radius_in_mm": {"outer": 10, "inner": 9}},
        "pp_contact": {"radius_in_mm": 3, "depth_in_mm": 2},
    },
    "characterization": {
        "l200_site": {"recommended_voltage_in_V": 4500.0},
        "combined_0vbb_analysis": {"fccd_in_mm": {"value": 0.75}},
    },
}


def legend(folder: Path, *extra: object, overrides: tuple[str, ...] = ()) -> Detector:
    """The diode, with ``geometry.extra`` if it is given."""
    geometry = DIODE["geometry"] | ({"extra": extra[0]} if extra else {})
    path = folder / "V99000A.json"
    path.write_text(json.dumps(DIODE | {"geometry": geometry}))
    return read_detector(path, overrides)


@pytest.mark.parametrize(
    "extra",
    [
        None,
        {},
        {"top_cylinder": {"radius_in_mm": 35, "height_in_mm": 25}},
        {"top_cylinder": {"radius_in_mm": 30, "height_in_mm": 0}},
        {"bottom_cylinder": {"radius_in_mm": 35, "height_in_mm": 25, "transition_in_mm": 5}},
        {"bottom_cylinder": {"radius_in_mm": 33, "height_in_mm": 0, "transition_in_mm": 0}},
        {"topgroove": {"radius_in_mm": 20, "depth_in_mm": 0}},
        {"topgroove": {"radius_in_mm": 5, "depth_in_mm": 3}},
        {"crack": {"radius_in_mm": 8, "angle_in_deg": 40, "width_in_mm": 0}},
    ],
)
def test_extra_shapes_that_change_nothing(tmp_path: Path, extra: object) -> None:
    assert legend(tmp_path, extra).fingerprint() == legend(tmp_path).fingerprint()


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (
            {"crack": {"radius_in_mm": 8, "width_in_mm": 22}},
            "crack cuts off a side; only",
        ),
        ({"hole": {"depth_in_mm": 5}}, "hole.depth_in_mm"),
    ],
)
def test_extra_shapes_that_no_crystal_has(tmp_path: Path, extra: object, said: str) -> None:
    with pytest.raises(CpunetError, match=rf"geometry\.extra\.{said}"):
        legend(tmp_path, extra)


def test_symmetric_extra_shapes_are_simulated(tmp_path: Path) -> None:
    extra: dict[str, Any] = {
        "topgroove": {"radius_in_mm": 20, "depth_in_mm": 5},
        "bottom_cylinder": {"radius_in_mm": 33, "height_in_mm": 25, "transition_in_mm": 4},
        "top_cylinder": {"radius_in_mm": 30, "height_in_mm": 10},
    }
    found = legend(tmp_path, extra)
    # r, z (mm) beside each surface: germanium and none
    inside = [(19.9, 74.9), (20.1, 75.1), (32.9, 24.9), (33.9, 27), (29.9, 75), (34.9, 69.9)]
    outside = [(19.9, 75.1), (19.9, 79), (33.1, 24.9), (34.1, 27), (30.1, 75), (34.9, 70.1)]
    for places, truth in ((inside, True), (outside, False)):
        assert (found.inside(*np.transpose(places)) == truth).all()
    with pytest.raises(CpunetError, match="top_groove_depth and top_groove_radius must both"):
        legend(tmp_path, {"topgroove": {"depth_in_mm": 5}})


def test_the_temperature_of_liquid_argon_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "cpunet"):
        # argon boils at 87.3 K
        assert legend(tmp_path).temperature_K == pytest.approx(87.3, abs=0.5)
        assert "tells no temperature; 87 K" in caplog.text
        caplog.clear()
        assert legend(tmp_path, overrides=("temperature_K=90",)).temperature_K == 90
        assert not caplog.messages
