"""Detectors from files of three kinds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from cpunet.errors import CpunetError
from cpunet.simulation.geometry_readers import detector_names, read_detector

SIGGEN = """
# general
verbosity_level 0   # quiet
xtal_length 96.0    # z length
xtal_radius 40.45
top_bullet_radius 0
pc_length 2
pc_radius 2.3
bulletize_PC 0
wrap_around_radius 14
ditch_depth 2
ditch_thickness 3
hole_length 69.9
hole_radius 5
hole_bullet_radius 5
outer_taper_length 35
inner_taper_length 0
taper_angle 10
Li_thickness 1.0
xtal_grid 0.1
impurity_z0 -1.80
impurity_gradient 0.10
xtal_HV 4000
drift_name ./drift_vel.dat
max_iterations 50000
xtal_temp 90
"""
DIODE: dict[str, Any] = {
    "name": "B99000A",
    "type": "bege",
    "production": {
        "impcc": {
            "array": {
                "value_in_1e9e/cm3": [8.0, 12.0],
                "dist_from_contact_in_mm": [30.0, 0.0],
            }
        }
    },
    "geometry": {
        "height_in_mm": 30.0,
        "radius_in_mm": 35.0,
        "groove": {"depth_in_mm": 2.0, "radius_in_mm": {"outer": 10.5, "inner": 7.5}},
        "pp_contact": {"radius_in_mm": 7.5, "depth_in_mm": 0},
        "taper": {
            "top": {"angle_in_deg": 45, "height_in_mm": 5},
            "bottom": {"angle_in_deg": 0, "height_in_mm": 0},
        },
    },
    "characterization": {
        "manufacturer": {"recommended_voltage_in_V": 3500, "dl_thickness_in_mm": 0.7}
    },
}


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def refused(path: Path | str, *overrides: str) -> str:
    with pytest.raises(CpunetError) as caught:
        read_detector(path, overrides)
    message = str(caught.value)
    assert "\n" not in message
    assert Path(path).name in message
    return message


@pytest.mark.parametrize("name", detector_names())
def test_the_examples_are_possible(name: str) -> None:
    assert read_detector(name).name == name


def test_the_reference_geometry_is_the_example(reference_data: Path) -> None:
    theirs = read_detector(reference_data / "siggen" / "geometry_A.yaml")
    assert theirs.fingerprint() == read_detector("icpc").fingerprint()


def test_a_siggen_configuration_is_the_same_detector(tmp_path: Path) -> None:
    detector = read_detector(written(tmp_path, "V1.config", SIGGEN))
    assert detector.fingerprint() == read_detector("icpc").fingerprint()
    assert detector.name == "V1"


def test_siggen_gives_gaps_and_widths(tmp_path: Path) -> None:
    text = SIGGEN.replace("hole_length 69.9", "hole_length_gap 26.1")
    text = text.replace("taper_angle 10", "outer_taper_width 6.1714")
    detector = read_detector(written(tmp_path, "V1.config", text))
    assert detector.bore_length == pytest.approx(69.9)
    assert detector.taper_angle_deg == pytest.approx(10, abs=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("pc_radius 2.3", "pc_radius", "pc_radius"),
        ("pc_radius 2.3", "pc_radius 2,3", "pc_radius"),
        ("pc_radius 2.3", "pc_radios 2.3", "pc_radios"),
        ("pc_radius 2.3", "", "point_contact_radius"),
        ("bulletize_PC 0", "bulletize_PC 1", "bulletize_PC"),
        ("hole_length 69.9", "hole_length 94", "bore_length"),
    ],
)
def test_bad_siggen_lines_are_named(tmp_path: Path, old: str, new: str, key: str) -> None:
    assert key in refused(written(tmp_path, "V1.config", SIGGEN.replace(old, new)))


@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_a_legend_diode(tmp_path: Path, suffix: str) -> None:
    text = json.dumps(DIODE) if suffix == "json" else yaml.safe_dump(DIODE)
    path = written(tmp_path, f"B99000A.{suffix}", text)
    assert "temperature_K" in refused(path)
    detector = read_detector(path, ["temperature_K=90"])
    assert detector.name == "B99000A"
    assert (detector.crystal_length, detector.point_contact_radius) == (30, 7.5)
    assert (detector.wrap_around_radius, detector.ditch_thickness) == (10.5, 3)
    assert (detector.outer_taper_length, detector.taper_angle_deg) == (5, 45)
    assert (detector.bias_V, detector.li_thickness) == (3500, 0.7)
    assert detector.impurity_1e10_per_cm3(0, [0, 15]) == pytest.approx([-1.2, -1.0])


@pytest.mark.parametrize(
    ("key", "value"),
    [("height", 30.0), ("height_in_cm", 3.0), ("extra", {"topgroove": {"depth_in_mm": 3}})],
)
def test_unknown_shapes_and_units_are_named(tmp_path: Path, key: str, value: object) -> None:
    diode = {**DIODE, "geometry": {**DIODE["geometry"], key: value}}
    assert key in refused(written(tmp_path, "B.json", json.dumps(diode)), "temperature_K=90")


def test_other_kinds_of_diodes_are_refused(tmp_path: Path) -> None:
    text = json.dumps({**DIODE, "type": "coax"})
    assert "coax" in refused(written(tmp_path, "C.json", text))
    lacking = {k: v for k, v in DIODE["geometry"].items() if k != "pp_contact"}
    text = json.dumps({**DIODE, "geometry": lacking})
    assert "pp_contact" in refused(written(tmp_path, "B.json", text))
    text = json.dumps({**DIODE, "geometry": 3})
    assert "geometry" in refused(written(tmp_path, "B.json", text))
    text = json.dumps({**DIODE, "production": {"impcc": {"array": {"dist": [1]}}}})
    assert "impcc" in refused(written(tmp_path, "B.json", text))


@pytest.mark.parametrize("text", ["", "a: [", "- 1", "{", "3"])
def test_files_without_keys_are_refused(tmp_path: Path, text: str) -> None:
    refused(written(tmp_path, "d.yaml", text))


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    assert "icpc" in refused(tmp_path / "nothing.yaml")
    refused(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    refused(tmp_path / "binary.yaml")
    assert "KEY=VALUE" in refused("icpc", "bias_V")
    assert "bias_kV" in refused("icpc", "bias_kV=4")
    assert "bias_V" in refused("icpc", "bias_V=high")
    refused("icpc", "bias_V=[")
