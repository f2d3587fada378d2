"""Shifts: nothing by default, each key where it belongs, and bad ones in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from cpunet.errors import CpunetError
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.shifted import Shift

OF_THE_DETECTOR = {
    "temperature_K": ("temperature_K", 2.0, 2.0),
    "bias_V": ("bias_V", 20.0, 20.0),
    "li_thickness_mm": ("li_thickness", 0.1, 0.1),
    "impurity_tilt_1e10_per_cm4": ("impurity_tilt_1e10_per_cm4", 0.01, 0.01),
    "impurity_factor": ("impurity_scale", 1.03, 0.03),
}
OF_THE_SETTINGS = {
    "cloud_fwhm_mm": 0.3,
    "diffusion_constant": 0.09,
    "self_repulsion": 0.5,
    "hole_velocity_low_factor": 0.95,
    "hole_velocity_high_factor": 0.95,
    "electron_velocity_low_factor": 1.05,
    "electron_velocity_high_factor": 1.05,
    "hole_trapping_per_us": 0.01,
    "electron_trapping_per_us": 0.01,
}


def test_every_key_has_its_place() -> None:
    detector, settings = read_detector("icpc"), SimulationSettings()
    assert set(Shift.model_fields) == set(OF_THE_DETECTOR) | set(OF_THE_SETTINGS)
    assert Shift().detector(detector) == detector
    assert Shift().settings(settings) == settings
    for key, (field, value, change) in OF_THE_DETECTOR.items():
        shift = Shift(**{key: value})
        moved = shift.detector(detector).model_dump()
        before = detector.model_dump()
        assert moved.pop(field) - before.pop(field) == pytest.approx(change)
        assert moved == before
        assert shift.settings(settings) == settings
    for key, value in OF_THE_SETTINGS.items():
        shift = Shift(**{key: value})
        expected = settings.model_copy(update={key: value})
        assert shift.settings(settings) == expected
        assert shift.detector(detector) == detector


def test_files_and_single_keys(tmp_path: Path) -> None:
    file = tmp_path / "shift.yaml"
    file.write_text("temperature_K: 1\nself_repulsion: true\n")
    shift = Shift.of([str(file), "temperature_K=1.5"])
    assert shift == Shift(temperature_K=1.5, self_repulsion=1.0)


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ("temprature_K=1", "temprature_K: no such setting; did you mean temperature_K?"),
        ("temperature_K=warm", "temperature_K: Input should be a valid number, "),
        ("temperature_K=.nan", "finite"),
        ("impurity_factor=0", "greater than 0"),
        ("diffusion_constant=cold", "diffusion_constant"),
        ("diffusion_constant=true", "diffusion_constant: Input should be a number"),
        ("cloud_fwhm_mm=true", "cloud_fwhm_mm: Input should be a number, not true or false"),
        ("nowhere.yaml", "nowhere.yaml: neither a file nor one of default"),
        ("a={", "not YAML"),
    ],
)
def test_bad_shifts_are_named(part: str, said: str) -> None:
    with pytest.raises(CpunetError) as raised:
        Shift.of([part])
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_impossible_detectors_and_settings_are_refused() -> None:
    with pytest.raises(CpunetError, match=r"shifted: temperature_K: .*less than or equal"):
        Shift(temperature_K=100).detector(read_detector("icpc"))
    with pytest.raises(CpunetError, match=r"hole_trapping_per_us: .*-1"):
        Shift(hole_trapping_per_us=-1).settings(SimulationSettings())
