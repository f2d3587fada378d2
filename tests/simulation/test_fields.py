"""Field maps: against the reference simulator and formulas, on disk, and undepleted ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.constants import elementary_charge, epsilon_0

from cpunet.errors import CpunetError
from cpunet.simulation.fields import (
    FieldMaps,
    compute_fields,
    electric_field,
    scaled_to_depletion,
    solve,
    solved,
)
from cpunet.simulation.geometry import Detector, RegionArray
from cpunet.simulation.geometry_readers import detector_names, read_detector
from cpunet.simulation.outline import GERMANIUM, LI_CONTACT
from cpunet.simulation.poisson import (
    EPSILON_GERMANIUM,
    VOLT_PER_MM2,
    make_grid,
    solve_potentials,
    surface_charges,
)

COARSE = ["grid_mm=0.5"]
PARTS: dict[str, list[str]] = {
    "plain": [],
    "charged": ["surface_charge_1e10_per_cm2=-0.02"],
    "grounded": ["vacuum_gap=1", "surface_charge_1e10_per_cm2=0.02"],
}
# no multiples of the grid, so that contacts lie between nodes
INNER, OUTER = 2.04, 8.53
IMPURITY = -1.5  # 1e10 / cm3
CURVATURE = 1.5e16 * elementary_charge / (epsilon_0 * EPSILON_GERMANIUM) * 1e-6  # V / mm2
SQUARE_MM = 10 * VOLT_PER_MM2 / (2 * np.pi)  # of the unit 1e10 / cm2, per rad


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
            both = (getattr(one, name) for one in (fields, expected))
            np.testing.assert_allclose(*both, atol=1e-6)
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


class Cylinders(Detector):
    """The point contact on the axis, lithium around it, the same at all heights."""

    def region(self, r: npt.ArrayLike, z: npt.ArrayLike) -> RegionArray:
        r, z = np.broadcast_arrays(np.asarray(r, float), np.asarray(z, float))
        return np.where(r <= INNER, 0, np.where(r >= OUTER, 1, 2)).astype(np.int8)


class Hemispheres(Detector):
    """The point contact around the origin, lithium around it."""

    def region(self, r: npt.ArrayLike, z: npt.ArrayLike) -> RegionArray:
        rho = np.hypot(np.asarray(r, float), np.asarray(z, float))
        return np.where(rho <= INNER, 0, np.where(rho >= OUTER, 1, 2)).astype(np.int8)


def values(grid_mm: float = 0.1) -> dict[str, float]:
    return {
        "crystal_length": 9.0, "crystal_radius": 9.0, "point_contact_length": 2.0,
        "point_contact_radius": 2.0, "li_thickness": 0.5, "impurity_z0_1e10_per_cm3": IMPURITY,
        "bias_V": 500, "temperature_K": 90, "grid_mm": grid_mm,
    }  # fmt: skip


def cylinder_potential(r: npt.NDArray[np.float64], volts: float) -> npt.NDArray[np.float64]:
    """Of the space charge, 0 at INNER and `volts` at OUTER."""
    log = (volts - CURVATURE / 4 * (OUTER**2 - INNER**2)) / np.log(OUTER / INNER)
    return CURVATURE / 4 * (r**2 - INNER**2) + log * np.log(r / INNER)


def test_cylinders() -> None:
    detector = Cylinders(**values())
    grid = make_grid(detector)
    found = solve_potentials(detector, grid)
    free = grid.region > LI_CONTACT
    inside = free[:, 0]
    r = grid.r_mm[inside]
    expected = cylinder_potential(r, 500)
    for row in (0, 37, -1):
        total = 500 * found.bias[inside, row] + found.impurities[inside, row]
        np.testing.assert_allclose(total, expected, atol=0.05)
    wp = np.log(OUTER / r) / np.log(OUTER / INNER)
    np.testing.assert_allclose(found.weighting_potential[inside, 5], wp, atol=3e-4)
    e_r, e_z = electric_field(500 * found.bias + found.impurities, grid, mirror=True)
    log = (500 - CURVATURE / 4 * (OUTER**2 - INNER**2)) / np.log(OUTER / INNER)
    expected = -10 * (CURVATURE / 2 * r + log / r)
    np.testing.assert_allclose(e_r[inside, 20][1:-1], expected[1:-1], rtol=5e-3)
    np.testing.assert_allclose(e_r[inside, 20], expected, rtol=0.1)
    assert np.abs(e_z).max() < 1e-6
    assert not e_r[~free].any()
    capacitance = 2 * np.pi * EPSILON_GERMANIUM * epsilon_0 * 1e9 * 9  # 9 mm high
    capacitance /= np.log(OUTER / INNER)
    assert found.capacitance_pF == pytest.approx(capacitance, rel=1e-3)
    # the bias at which the field at the inner contact vanishes
    expected = CURVATURE / 4 * (OUTER**2 - INNER**2)
    expected -= CURVATURE / 2 * INNER**2 * np.log(OUTER / INNER)
    for potentials in (found, solve_potentials(detector, make_grid(Cylinders(**values(0.2))))):
        assert potentials.depletion() == pytest.approx(expected, abs=20 * potentials.grid_mm)


def test_hemispheres_and_the_axis() -> None:
    detector = Hemispheres(**values())
    grid = make_grid(detector)
    found = solve_potentials(detector, grid)
    free = grid.region > LI_CONTACT
    rho = np.hypot(grid.r_mm[:, np.newaxis], grid.z_mm)[free]
    wp = (1 / rho - 1 / OUTER) / (1 / INNER - 1 / OUTER)
    np.testing.assert_allclose(found.weighting_potential[free], wp, atol=3e-3)
    on_axis = free[0]
    z = grid.z_mm[on_axis]
    wp = (1 / z - 1 / OUTER) / (1 / INNER - 1 / OUTER)
    np.testing.assert_allclose(found.weighting_potential[0, on_axis], wp, atol=2e-3)
    # V = k rho^2 / 6 + c + d / rho, 0 on both
    k = CURVATURE / 6
    d = -k * (OUTER**2 - INNER**2) / (1 / OUTER - 1 / INNER)
    expected = k * rho**2 + d / rho - k * INNER**2 - d / INNER
    np.testing.assert_allclose(found.impurities[free], expected, atol=0.5)
    half_sphere = 2 * np.pi * EPSILON_GERMANIUM * epsilon_0 * 1e9 / (1 / INNER - 1 / OUTER)
    assert found.capacitance_pF == pytest.approx(half_sphere, rel=5e-3)


def test_a_grounded_plane_and_a_surface_charge_lower_the_potential() -> None:
    plain, gap = Hemispheres(**values(0.2)), {"vacuum_gap": 1.0}
    charged = plain.model_copy(update={"surface_charge_1e10_per_cm2": -0.1})
    grid = make_grid(plain)
    found = [solve_potentials(d, grid) for d in (plain, charged, plain.model_copy(update=gap))]
    without, with_it = (potentials.impurities + potentials.surface for potentials in found[:2])
    assert (found[2].weighting_potential + found[2].bias).min() < 1 - 1e-3
    assert (with_it <= without + 1e-9).all()
    assert with_it[25, 0] < without[25, 0] - 1


def test_the_opening_of_the_ditch_carries_no_surface_charge() -> None:
    more = ["grid_mm=0.25", "surface_charge_1e10_per_cm2=1"]
    siggen, bege = read_detector("icpc", more), read_detector("bege", more)
    grid = make_grid(siggen)
    charge = surface_charges(siggen, grid)
    # germanium nodes on z = 0 lie between 2.5 and 10.75 mm
    assert not charge[:, 1:].any()
    assert not charge[grid.region[:, 0] != GERMANIUM].any()
    assert charge.sum() == pytest.approx(SQUARE_MM * np.pi * (10.875**2 - 2.375**2))
    with pytest.raises(CpunetError, match=r"no germanium on z = 0 .* siggen_conventions=false"):
        surface_charges(bege, make_grid(bege))


def test_the_walls_of_an_exact_ditch_are_passivated_as_well() -> None:
    more = ["grid_mm=0.25", "surface_charge_1e10_per_cm2=1", "siggen_conventions=false"]
    for name, inner, outer, depth in (("icpc", 11, 14, 2), ("bege", 7.5, 10.5, 2)):
        detector = read_detector(name, more)
        charge = surface_charges(detector, grid := make_grid(detector))
        r, z = grid.r_mm[:, np.newaxis], grid.z_mm
        in_vacuum = (r > inner + 0.01) & (r < outer - 0.01) & (z < depth - 0.01)
        assert not charge[in_vacuum].any()
        of_ditch = np.pi * (outer**2 - inner**2 + 2 * depth * (inner + outer))
        walls = (r > inner - 0.01) & (r < outer + 0.01) & (z > 0) & (z < depth + 0.01)
        # the lower half step of the walls lies on the nodes of z = 0
        of_ditch -= 2 * np.pi * 0.125 * (inner + outer)
        assert charge[walls].sum() == pytest.approx(SQUARE_MM * of_ditch)
