"""Detectors from files: our own, siggen's, LEGEND's metadata."""

from __future__ import annotations

import copy
import json
import logging
import shutil
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import yaml

from cpunet.errors import CpunetError
from cpunet.simulation.fields import compute_fields
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from synthetic import one_line

Array = npt.NDArray[np.float64]

SIGGEN = """
# general
verbosity_level 0   # quiet
xtal_length 96.0  # z length; xtal_radius 40.45; top_bullet_radius 0; pc_length 2
pc_radius 2.3; bulletize_PC 0; wrap_around_radius 14; ditch_depth 2
ditch_thickness 3; hole_length 69.9; hole_radius 5; hole_bullet_radius 5
outer_taper_length 35; inner_taper_length 0; taper_angle 10; Li_thickness 1.0
xtal_grid 0.1; impurity_z0 -1.80; impurity_gradient 0.10; xtal_HV 4000
drift_name ./drift_vel.dat; max_iterations 50000; xtal_temp 90
""".replace("; ", "\n")
IMPURITIES = "impurity_z0_1e10_per_cm3=-1"
TAPERS = (("top", 45, 5), ("bottom", 0, 0))
DIODE: dict[str, Any] = {
    "name": "B99000A",
    "type": "bege",
    "geometry": {
        "height_in_mm": 30.0,
        "radius_in_mm": 35.0,
        "groove": {"depth_in_mm": 2.0, "radius_in_mm": {"outer": 10.5, "inner": 7.5}},
        "pp_contact": {"radius_in_mm": 7.5, "depth_in_mm": 0},
        "taper": {end: {"angle_in_deg": a, "height_in_mm": h} for end, a, h in TAPERS},
    },
    "characterization": {
        "manufacturer": {"recommended_voltage_in_V": 3500, "dl_thickness_in_mm": 0.7}
    },
}
CRYSTAL: dict[str, Any] = {
    "impurity_curve": {
        "model": "parabolic_exponential_boule",
        "parameters": {"a": 9.0, "b": 0.05, "c": -1e-4, "n": 0.3, "l": 60.0, "m": 20.0},
        "corrections": {"scale": 1.2, "offset": -0.4},
    },
    "slices": {"A": {"detector_offset_in_mm": 90.0}, "B": {"detector_offset_in_mm": 40}},
}
TAPERED = "outer_taper_length 20\nouter_taper_width 4\ninner_taper_length 45"
RADIAL = "impurity_radial_add -0.4\nimpurity_radial_mult 1.5"


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def refused(path: Path | str, *overrides: str) -> str:
    with pytest.raises(CpunetError) as caught:
        read_detector(path, overrides)
    message = str(caught.value)
    assert Path(path).name in message
    return message


def test_the_reference_geometry_is_the_example(reference_data: Path, tmp_path: Path) -> None:
    paths = reference_data / "siggen" / "geometry_A.yaml", tmp_path / "V1.config"
    paths[1].write_text(SIGGEN)
    icpc = read_detector("icpc")
    for path, name in zip(paths, ("geometry_A", "V1"), strict=True):
        assert read_detector(path) == icpc.model_copy(update={"name": name})


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("pc_radius 2.3", "pc_radius", "pc_radius"),
        ("pc_radius 2.3", "pc_radius 2,3", "pc_radius"),
        ("pc_radius 2.3", "pc_radios 2.3", "pc_radios"),
        ("pc_radius 2.3", "", "point_contact_radius"),
        ("bulletize_PC 0", "bulletize_PC 1", "bulletize_PC"),
        ("bulletize_PC 0", "hole_offset_y_top 4", "is not 0; only axially symmetric"),
    ],
)
def test_bad_siggen_lines_are_named(tmp_path: Path, old: str, new: str, key: str) -> None:
    assert key in refused(written(tmp_path, "V1.config", SIGGEN.replace(old, new)))


@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_a_legend_diode(tmp_path: Path, suffix: str, caplog) -> None:
    caplog.set_level(logging.INFO, "cpunet")
    text = json.dumps(DIODE) if suffix == "json" else yaml.safe_dump(DIODE)
    path = written(tmp_path, f"B99000A.{suffix}", text)
    detector = read_detector(path, [IMPURITIES, "temperature_K=90"])
    assert detector.temperature_K == 90
    assert not caplog.messages
    # of the argon around the detector, which boils at 87.3 K
    assert read_detector(path, [IMPURITIES]).temperature_K == pytest.approx(87.3, abs=0.5)
    assert "tells no temperature; 87 K" in caplog.text
    assert detector.name == "B99000A"
    assert (detector.crystal_length, detector.point_contact_radius) == (30, 7.5)
    assert (detector.wrap_around_radius, detector.ditch_thickness) == (10.5, 3)
    assert (detector.outer_taper_length, detector.taper_angle_deg) == (5, 45)
    assert (detector.bias_V, detector.li_thickness) == (3500, 0.7)


def acceptors_1e9(z_boule: Array, *, a: float, b: float, **more: float) -> Array:
    """The curve of the metadata, in their own unit and frame."""
    curve = a + b * z_boule + more.get("c", 0) * z_boule**2
    if more.get("n"):
        curve = curve + more["n"] * np.exp((z_boule - more["l"]) / more["m"])
    return curve


def metadata(folder: Path, crystal: dict[str, Any] | None, diode: dict[str, Any]) -> Path:
    """A diode without impurities of its own, and the crystal in its place beside it."""
    (folder / "diodes").mkdir()
    (folder / "crystals").mkdir()
    if crystal is not None:
        written(folder / "crystals", "B99000.yaml", yaml.safe_dump(crystal))
    return written(folder / "diodes", "B99000A.yaml", yaml.safe_dump(diode))


@pytest.mark.parametrize("keys", ["abcnlm", "abnlm", "abc", "ab"])
def test_impurities_of_the_crystal(tmp_path: Path, keys: str) -> None:
    names = {"abcnlm": "parabolic_exponential", "abnlm": "linear_exponential"}
    names |= {"abc": "parabolic", "ab": "linear"}
    parameters = {key: CRYSTAL["impurity_curve"]["parameters"][key] for key in keys}
    curve = {"model": f"{names[keys]}_boule", "parameters": parameters}
    crystal = {**CRYSTAL, "impurity_curve": {**CRYSTAL["impurity_curve"], **curve}}
    path = metadata(tmp_path, crystal, DIODE)
    z = np.linspace(0, 30, 7)
    # z of the boule runs from its seed end to the point contact, 90 mm from there
    expected = -(1.2 * acceptors_1e9(90 - z, **parameters) - 0.4) / 10
    found = read_detector(path, ["temperature_K=90"]).impurity_1e10_per_cm3(0, z)
    assert found == pytest.approx(expected, rel=1e-12)
    # another slice, without corrections, from JSON
    plain = {"slices": crystal["slices"], "impurity_curve": curve}
    (tmp_path / "crystals" / "B99000.yaml").unlink()
    written(tmp_path / "crystals", "B99000.json", json.dumps(plain, indent="\t"))
    diode = DIODE | {"production": {"slice": "B"}}
    path = written(tmp_path / "diodes", "B99000A.yaml", yaml.safe_dump(diode))
    found = read_detector(path, ["temperature_K=90"]).impurity_1e10_per_cm3(0, z)
    assert found == pytest.approx(-acceptors_1e9(40 - z, **parameters) / 10, rel=1e-12)


def test_the_public_metadata(reference_data: Path) -> None:
    diodes = reference_data / "legend-metadata" / "diodes"
    icpc = read_detector(diodes / "V99000A.yaml", ["temperature_K=90"])
    assert (icpc.bias_V, icpc.measured_depletion_V, icpc.li_thickness) == (4000, 4000, 0.75)
    curve = acceptors_1e9(np.array([80.0, 0.0]), a=8.438, b=0.03898)
    assert icpc.impurity_1e10_per_cm3(0, [0, 80]) == pytest.approx(-curve / 10)
    bege = read_detector(diodes / "B99000A.yaml", ["temperature_K=90"])
    parameters = {"a": 8.878, "b": 0.05814, "c": -6.66e-5, "n": 0.008353}
    curve = acceptors_1e9(np.array([40.0, 0.0]), **parameters, l=99.46, m=1.623)
    assert bege.impurity_1e10_per_cm3(0, [0, 40]) == pytest.approx(-curve / 10)
    said = refused(diodes / "P99000A.yaml", "temperature_K=90")
    assert "there is no" in said
    assert "crystals/P99000.yaml); give `settings` impurity_z0_1e10_per_cm3=VALUE" in said
    ppc = read_detector(diodes / "P99000A.yaml", [IMPURITIES])
    # where the site knows no voltage (0), the manufacturer's counts
    assert (ppc.bias_V, ppc.measured_depletion_V) == (3000, 3000)
    assert "type 'coax' is not simulated" in refused(diodes / "C99000A.yaml")


@pytest.mark.usefixtures("own_cache")
def test_impurities_by_the_depletion_voltage(
    reference_data: Path, tmp_path: Path, caplog
) -> None:
    caplog.set_level("INFO", "cpunet")
    metadata = reference_data / "legend-metadata"
    diode = Path(shutil.copy(metadata / "diodes" / "P99000A.yaml", tmp_path))
    shutil.copy(metadata / "crystals" / "V99000.yaml", tmp_path / "P99000.yaml")
    values = ["temperature_K=85", "bias_V=3300", "grid_mm=0.5", "impurity_scale=depletion"]
    scaled = read_detector(diode, values)
    assert "so that it depletes at the measured 3000 V" in caplog.text
    # with the maker's impurities, P99000A would deplete at some 2260 V
    assert 1.2 < scaled.impurity_scale < 1.5
    assert compute_fields(scaled).depletion_V == pytest.approx(3000, abs=1)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("impurity_curve.model", "spline_boule", "impurity_curve.model 'spline_boule'"),
        ("impurity_curve.parameters.b", None, "no impurity_curve.parameters.b"),
        ("impurity_curve.parameters.b", "much", "parameters.b = 'much' is no number"),
        ("impurity_curve.parameters.m", 0, "impurity_curve.parameters.m = 0"),
        ("impurity_curve.corrections.scale", True, "corrections.scale = True is no number"),
        ("slices.A", None, "no slices.A.detector_offset_in_mm"),
    ],
)
def test_wrong_crystals_name_the_field(
    tmp_path: Path, place: str, value: object, said: str
) -> None:
    crystal = copy.deepcopy(CRYSTAL)
    *folders, last = place.split(".")
    reduce(dict.__getitem__, folders, crystal)[last] = value
    path = metadata(tmp_path, crystal, DIODE)
    file = f"{tmp_path / 'crystals' / 'B99000.yaml'}: "
    read = lambda: read_detector(path, ["temperature_K=90"])  # noqa: E731
    one_line(read, file, said, "another file of the crystal")


def test_what_the_metadata_lack_is_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    site = {"manufacturer": {"recommended_voltage_in_V": 0, "dl_thickness_in_mm": None}}
    path = metadata(tmp_path, {"name": "000"}, DIODE | {"characterization": site})
    given = ["temperature_K=90", "li_thickness=1", "bias_V=3000"]
    said = refused(path, *given)
    assert "B99000.yaml has no impurity_curve); give `settings` impurity_z0" in said
    given += [IMPURITIES]
    assert read_detector(path, given).bias_V == 3000
    assert "combined_0vbb_analysis.fccd_in_mm.value nor" in refused(path, *given[2:])
    said = refused(path, given[0], given[1], given[3])
    assert "l200_site.recommended_voltage_in_V nor" in said
    assert said.endswith("give `settings` bias_V=VALUE")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("value", ["4.4 kV", True, [4400], {"V": 4400}, -4400])
@pytest.mark.parametrize("place", ["recommended_voltage_in_V", ""])
def test_a_wrong_value_is_not_passed_over(tmp_path: Path, value: object, place: str) -> None:
    sites = {"l200_site": {place: value} if place else value, **DIODE["characterization"]}
    path = metadata(tmp_path, CRYSTAL, DIODE | {"characterization": sites})
    if place or not isinstance(value, dict):
        said = refused(path)
        assert "l200_site.recommended_voltage_in_V" in said


def test_an_exponential_that_ends_before_the_detector(tmp_path: Path) -> None:
    crystal = copy.deepcopy(CRYSTAL)
    crystal["impurity_curve"]["parameters"] |= {"l": 200.0, "m": 0.1}
    detector = read_detector(metadata(tmp_path, crystal, DIODE), ["temperature_K=90"])
    assert detector.impurity_exponential_1e10_per_cm3 == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"type": "coax"}, "type 'coax' is not simulated"),
        ({"geometry": 3}, "geometry"),
        ({"pp_contact": None}, "pp_contact"),
        ({"height": 30.0}, "unknown key geometry.height "),
        ({"height_in_cm": 3.0}, "unknown key geometry.height_in_cm"),
        ({"extra": {"hole": {"depth_in_mm": 3}}}, "geometry.extra.hole.depth_in_mm"),
        ({"extra": {"crack": {"radius_in_mm": 8, "width_in_mm": 22}}}, "cuts off a side; only"),
    ],
)
def test_diodes_that_cannot_be_simulated(tmp_path, change: dict[str, Any], said: str) -> None:
    geometry = {k: v for k, v in (DIODE["geometry"] | change).items() if v is not None}
    diode = DIODE | (change if change.keys() <= DIODE.keys() else {"geometry": geometry})
    assert said in refused(written(tmp_path, "B.json", json.dumps(diode)), "temperature_K=90")


def siggen(folder: Path, more: str = "", without: str = "#") -> Detector:
    """The detector of the configuration, with lines added at its end or left out."""
    lines = [line for line in SIGGEN.splitlines() if not line.startswith(without)]
    return read_detector(written(folder, "D.config", "\n".join([*lines, more, ""])))


@pytest.mark.parametrize(
    ("more", "without", "field", "value"),
    [
        ("xtal_diam 70.5", "xtal_radius", "crystal_radius", 35.25),
        ("pc_diam 7", "pc_radius", "point_contact_radius", 3.5),
        ("hole_diam 9", "hole_radius", "bore_radius", 4.5),
        ("taper_length 4.5", "#", "bottom_taper_length", 4.5),
        ("pc_radius 4", "#", "point_contact_radius", 4),
        # lines that begin with a space are comments
        (" pc_radius 4\n\tpc_radius 5", "#", "point_contact_radius", 2.3),
        # as far as the ditch, where a larger one ends, and one of 0 is meant
        ("pc_radius 14", "#", "point_contact_radius", 11),
        ("pc_radius 0", "#", "point_contact_radius", 11),
        ("hole_bullet_radius 6", "#", "bore_bullet_radius", 5),
        # a taper ends where the bottom of the hole is rounded, as wide as it was meant to be
        ("inner_taper_length 68", "#", "inner_taper_length", 64.9),
        ("inner_taper_length 68", "#", "inner_taper_angle_deg", 10.467333),
        ("inner_taper_length 68\nhole_bullet_radius 6", "#", "inner_taper_length", 63.9),
        ("hole_length_gap 32", "#", "bore_length", 64),
        ("pc_offset_x 0\nhole_offset_y_top 0.0", "#", "bore_radius", 5),
        # no ditch: a wrap-around as far as the wall, or further, is none
        ("wrap_around_radius 40.45", "ditch", "wrap_around_radius", 0),
        # widths of tapers count where the angle is 0; that of one is not that of the other
        (f"{TAPERED}\ninner_taper_width 2", "taper_angle", "taper_slopes", (0.2, 2 / 45, 1)),
        (TAPERED, "taper_angle", "taper_slopes", (0.2, 0, 1)),
        (f"{TAPERED}\ntaper_angle 5", "#", "taper_slopes", (0.0874887, 0.0874887, 1)),
        # radial terms need a power
        (RADIAL, "#", "impurity_radial_add_1e10_per_cm3", 0),
        (f"{RADIAL}\nimpurity_rpower 0", "#", "impurity_radial_mult", 1),
        (f"{RADIAL}\nimpurity_rpower 2", "#", "impurity_radial_add_1e10_per_cm3", -0.4),
        (f"{RADIAL}\nimpurity_rpower 2", "#", "impurity_radial_mult", 1.5),
    ],
)
def test_siggens_own_rules(tmp_path, more, without, field, value) -> None:
    assert getattr(siggen(tmp_path, more, without), field) == pytest.approx(value)


def test_what_was_cut_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "cpunet"):
        siggen(tmp_path, "pc_radius 14")
    (said,) = caplog.messages
    assert "pc_radius is 11 mm, as in siggen: at most wrap_around_radius - ditch_th" in said


def legend(folder: Path, *extra: object) -> Detector:
    """A diode with a bore, and ``geometry.extra`` if it is given."""
    bore = {"borehole": {"radius_in_mm": 5, "depth_in_mm": 55}, "height_in_mm": 80}
    geometry = DIODE["geometry"] | bore | {"taper": {}} | ({"extra": extra[0]} if extra else {})
    text = json.dumps(DIODE | {"type": "icpc", "geometry": geometry})
    return read_detector(written(folder, "V99000A.json", text), [IMPURITIES])


@pytest.mark.parametrize(
    "extra",
    [
        None,
        {"top_cylinder": {"radius_in_mm": 35, "height_in_mm": 25}},
        {"bottom_cylinder": {"radius_in_mm": 35, "height_in_mm": 25, "transition_in_mm": 5}},
        {"topgroove": {"radius_in_mm": 20, "depth_in_mm": 0}},
        {"topgroove": {"radius_in_mm": 5, "depth_in_mm": 3}},
        {"crack": {"radius_in_mm": 8, "angle_in_deg": 40, "width_in_mm": 0}},
    ],
)
def test_extra_shapes_that_change_nothing(tmp_path: Path, extra: object) -> None:
    places = np.meshgrid(np.arange(0, 36, 0.25), np.arange(0, 81, 0.25))
    with_it, without = (legend(tmp_path, *more).region(*places) for more in ((extra,), ()))
    np.testing.assert_array_equal(with_it, without)


def test_symmetric_extra_shapes_are_simulated(tmp_path: Path) -> None:
    extra: dict[str, Any] = {
        "topgroove": {"radius_in_mm": 20, "depth_in_mm": 5},
        "bottom_cylinder": {"radius_in_mm": 33, "height_in_mm": 25, "transition_in_mm": 4},
        "top_cylinder": {"radius_in_mm": 30, "height_in_mm": 10},
    }
    found = legend(tmp_path, extra)
    assert (found.top_groove_radius, found.top_groove_depth) == (20, 5)
    assert (found.bottom_cylinder_radius, found.bottom_cylinder_length) == (33, 25)
    assert (found.top_cylinder_radius, found.top_cylinder_length) == (30, 10)
    assert found.bottom_transition_length == 4
    with pytest.raises(CpunetError, match="top_groove_depth and top_groove_radius must both"):
        legend(tmp_path, {"topgroove": {"depth_in_mm": 5}})
