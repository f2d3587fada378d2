"""Field maps: against the reference simulator, on disk, and refused when undepleted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.simulation.fields import (
    FieldMaps,
    compute_fields,
    scaled_to_depletion,
    solve,
    solved,
)
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import detector_names, read_detector

COARSE = ["grid_mm=0.5"]


@pytest.fixture(autouse=True)
def no_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CPUNET_CACHE", str(tmp_path / "cache"))


def same(one: FieldMaps, other: FieldMaps) -> bool:
    return all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())


@pytest.mark.thorough
def test_agrees_with_the_reference_simulator(reference_data: Path) -> None:
    detector = read_detector("icpc", ["siggen_conventions=true"])
    maps = compute_fields(detector)
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
    assert 0 < maps.depletion_V < detector.bias_V
    assert maps.potential_V.min() == 0
    assert (maps.potential_V[maps.region == 1] == detector.bias_V).all()
    assert (maps.weighting_potential[maps.region == 0] == 1).all()


def test_an_undepleted_detector_is_refused() -> None:
    with pytest.raises(CpunetError, match=r"bias_V = 2000 .*depletion voltage, 32\d\d V"):
        compute_fields(read_detector("icpc", [*COARSE, "bias_V=2000"]))
    with pytest.raises(CpunetError, match="impurity_z0"):
        compute_fields(read_detector("icpc", [*COARSE, "impurity_z0_1e10_per_cm3=-90"]))


def test_solved_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG", "cpunet")
    detector = read_detector("icpc", COARSE)
    first = compute_fields(detector)
    assert caplog.messages
    caplog.clear()
    warmer = detector.model_copy(update={"temperature_K": 100.0, "name": "warm"})
    second = compute_fields(warmer)
    np.testing.assert_array_equal(first.potential_V, second.potential_V)
    solved.cache_clear()  # from the disk
    assert same(first, compute_fields(detector))
    assert not caplog.messages
    thicker = detector.model_copy(update={"li_thickness": 1.1})
    compute_fields(thicker)
    assert caplog.messages


def test_a_damaged_cache_is_solved_anew_and_one_that_cannot_be_written_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    detector = read_detector("icpc", COARSE)
    first = compute_fields(detector)
    (path,) = tmp_path.glob("cache/fields/*.npz")
    whole = path.read_bytes()
    np.savez(path, r_mm=np.zeros(3))
    for damaged in (whole[: len(whole) // 2], b"", path.read_bytes()):
        solved.cache_clear()
        path.write_bytes(damaged)
        assert same(first, compute_fields(detector))
        assert len(path.read_bytes()) == len(whole)
    monkeypatch.setenv("CPUNET_CACHE", str(path))  # a file
    assert same(first, compute_fields(detector))


PARTS: dict[str, list[str]] = {
    "plain": [],
    "charged": ["surface_charge_1e10_per_cm2=-0.02"],
    "grounded": ["vacuum_gap=1", "surface_charge_1e10_per_cm2=0.02"],
}


@pytest.mark.parametrize("more", PARTS.values(), ids=PARTS)
def test_any_bias_and_impurity_from_one_solution(
    more: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    detector = read_detector("ppc", [*COARSE, *more])
    solve(detector)
    for bias, scale, tilt in ((2500.0, 1.0, 0.0), (3000.0, 1.1, 0.03), (2200.0, 0.6, 0.0)):
        values = {"bias_V": bias, "impurity_scale": scale, "impurity_tilt_1e10_per_cm4": tilt}
        wanted = detector.model_copy(update=values | {"temperature_K": 80})
        with caplog.at_level("DEBUG", "cpunet"):
            fields = compute_fields(wanted)
        # solved for on its own, the impurities written down as they are
        z0 = scale * detector.impurity_z0_1e10_per_cm3 - tilt * detector.crystal_length / 20
        gradient = scale * detector.impurity_gradient_1e10_per_cm4 + tilt
        written = {"impurity_z0_1e10_per_cm3": z0, "impurity_gradient_1e10_per_cm4": gradient}
        alone = detector.model_copy(update=written | {"bias_V": bias})
        expected = compute_fields(alone)
        for name in ("potential_V", "e_r_V_per_cm", "e_z_V_per_cm", "weighting_potential"):
            np.testing.assert_allclose(
                getattr(fields, name), getattr(expected, name), atol=1e-6
            )
        assert fields.depletion_V == pytest.approx(expected.depletion_V, abs=1)
    assert not caplog.messages


def test_a_scale_may_deplete_impurities_that_no_bias_depletes() -> None:
    plain = read_detector("ppc", COARSE)
    many = {"impurity_z0_1e10_per_cm3": -32.0, "impurity_gradient_1e10_per_cm4": 3.2}
    same_sum = plain.model_copy(update=many | {"impurity_scale": 1 / 40})
    assert solve(same_sum).depletion() == np.inf
    expected = compute_fields(plain).depletion_V
    assert compute_fields(same_sum).depletion_V == pytest.approx(expected, abs=1)


@pytest.mark.parametrize("more", PARTS.values(), ids=PARTS)
@pytest.mark.parametrize("measured", [1200.0, 2500.0])
def test_impurities_are_scaled_to_the_measured_depletion(
    more: list[str], measured: float
) -> None:
    detector = read_detector("ppc", [*COARSE, *more, f"measured_depletion_V={measured}"])
    scaled = scaled_to_depletion(detector)
    assert Detector.model_validate(scaled.model_dump()) == scaled
    # the bias is what the depletion was measured at: just depleted
    fields = compute_fields(scaled)
    assert fields.depletion_V == pytest.approx(measured, abs=1)


@pytest.mark.thorough
def test_a_detector_that_no_scale_depletes_at_the_measured_voltage() -> None:
    detector = read_detector("ppc", COARSE)
    with pytest.raises(CpunetError, match=r"no measured_depletion_V .* give"):
        scaled_to_depletion(detector)
    charged = {"surface_charge_1e10_per_cm2": -2.0}
    pure = {"impurity_z0_1e10_per_cm3": 0.0, "impurity_gradient_1e10_per_cm4": 0.0}
    for values in (charged, pure):
        wanted = detector.model_copy(update=values | {"measured_depletion_V": 2000.0})
        with pytest.raises(
            CpunetError, match=r"1000 times .* none depletes at 2000 V; correct"
        ):
            scaled_to_depletion(wanted)
