"""Field maps: against the reference simulator, on disk, and refused when undepleted."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.simulation.field_cache import cache_file
from cpunet.simulation.fields import FieldMaps, compute_fields
from cpunet.simulation.geometry_readers import detector_names, read_detector

COARSE = ["grid_mm=0.5"]


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CPUNET_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def same(one: FieldMaps, other: FieldMaps) -> bool:
    return all(np.array_equal(value, getattr(other, key)) for key, value in vars(one).items())


def test_agrees_with_the_reference_simulator(reference_data: Path) -> None:
    detector = read_detector("icpc", ["siggen_conventions=true"])
    start = time.perf_counter()
    maps = compute_fields(detector)
    assert time.perf_counter() - start < 15
    with np.load(reference_data / "siggen" / "maps_A_outertaper.npz") as reference:
        # every fifth node of 0.1 mm; their last column lies outside the crystal
        theirs = {key: reference[key][:81] for key in reference if reference[key].ndim == 2}

    def deviation(mine: np.ndarray, key: str) -> np.ndarray:
        germanium = np.isin(theirs["point_type"], (2, 3, 6, 7))
        return np.abs(mine[::5, ::5][:81] - theirs[key])[germanium]

    volts = deviation(maps.potential_V, "V_01")
    assert np.median(volts) < 0.15
    assert np.quantile(volts, 0.99) < 1.3
    for mine, key in ((maps.e_r_V_per_cm, "Er_01"), (maps.e_z_V_per_cm, "Ez_01")):
        assert np.median(deviation(mine, key)) < 0.1
        assert np.quantile(deviation(mine, key), 0.99) < 6
    weighting = deviation(maps.weighting_potential, "WP_01")
    assert np.median(weighting) < 1e-5
    assert np.quantile(weighting, 0.99) < 2e-3
    # theirs falls short by the sharp edge of the contact, as its own finer grids show
    assert maps.capacitance_pF == pytest.approx(2.545, rel=0.015)
    assert maps.depletion_V == pytest.approx(3224, abs=10)


@pytest.mark.parametrize("name", detector_names())
def test_the_examples_are_depleted(name: str) -> None:
    detector = read_detector(name, COARSE)
    maps = compute_fields(detector)
    shape = (len(maps.r_mm), len(maps.z_mm))
    assert maps.potential_V.shape == maps.point_type.shape == shape
    assert 0 < maps.depletion_V < detector.bias_V
    assert maps.potential_V.min() == 0
    assert maps.potential_V.max() == pytest.approx(detector.bias_V)
    assert maps.weighting_potential.max() == pytest.approx(1)
    assert maps.weighting_potential.min() > -1e-12
    assert (maps.potential_V[maps.point_type == 1] == detector.bias_V).all()
    assert (maps.weighting_potential[maps.point_type == 0] == 1).all()
    # far from any contact, the field is minus the slope of the potential
    i, j = np.argwhere(maps.point_type == 2).mean(axis=0).astype(int)
    slope = maps.potential_V[i + 1, j] - maps.potential_V[i - 1, j]
    assert maps.e_r_V_per_cm[i, j] == pytest.approx(-10 * slope / (2 * maps.grid_mm))


def test_an_undepleted_detector_is_refused() -> None:
    with pytest.raises(
        CpunetError, match=r"bias_V = 2000 .*depletion voltage, 32\d\d V"
    ) as caught:
        compute_fields(read_detector("icpc", [*COARSE, "bias_V=2000"]))
    assert "\n" not in str(caught.value)
    with pytest.raises(CpunetError, match="impurity_z0"):
        compute_fields(read_detector("icpc", [*COARSE, "impurity_z0_1e10_per_cm3=-90"]))


def test_a_grid_too_fine_is_refused() -> None:
    with pytest.raises(CpunetError, match="grid_mm"):
        compute_fields(read_detector("icpc", ["grid_mm=0.02"]))


def test_solved_once() -> None:
    detector = read_detector("icpc", COARSE)
    steps: list[str] = []
    first = compute_fields(detector, progress=steps.append)
    assert steps
    steps.clear()
    warmer = detector.model_copy(update={"temperature_K": 100.0, "name": "warm"})
    second = compute_fields(warmer, progress=steps.append)
    assert not steps
    assert second.temperature_K == 100
    np.testing.assert_array_equal(first.potential_V, second.potential_V)
    assert same(first, compute_fields(detector))
    compute_fields(detector.model_copy(update={"bias_V": 3900.0}), progress=steps.append)
    assert steps


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "other"])
def test_a_damaged_cache_is_solved_anew(damage: str) -> None:
    detector = read_detector("icpc", COARSE)
    first = compute_fields(detector)
    path = cache_file(detector.fingerprint(exclude=("name", "temperature_K")))
    whole = path.read_bytes()
    if damage == "other":
        np.savez(path, r_mm=np.zeros(3))
    else:
        path.write_bytes(
            {"cut": whole[: len(whole) // 2], "empty": b"", "text": b"x" * 99}[damage]
        )
    assert same(first, compute_fields(detector))
    assert len(path.read_bytes()) == len(whole)


def test_a_cache_that_cannot_be_written_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CPUNET_CACHE", str(tmp_path / "file"))
    assert compute_fields(read_detector("icpc", COARSE)).depletion_V > 0


def test_no_cache_leaves_nothing_behind(cache_folder: Path) -> None:
    compute_fields(read_detector("icpc", COARSE), cache=False)
    assert not cache_folder.exists()
