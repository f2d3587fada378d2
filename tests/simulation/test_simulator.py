"""Pulses of hits, how these are merged, velocities and paths: by hand and reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.ndimage import gaussian_filter1d

from cpunet.errors import CpunetError
from cpunet.simulation.drift_maps import ELECTRON, HOLE, V100, carrier_velocity, velocity_table
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator, merge_hits

PLAIN = SimulationSettings(dt_ns=1, length_ns=3600, diffusion=False, cloud_fwhm_mm=0)
CLOUDS = {"diffusion": True, "diffusion_constant": "siggen", "cloud_fwhm_mm": 0.1}
SIGGEN = PLAIN.model_copy(update=CLOUDS)
ICPC = read_detector("icpc")  # at 90 K, as the reference pulses
Array = npt.NDArray[np.float64]
TABLE = velocity_table(90)
RATES = {"hole_trapping_per_us": 2.0, "electron_trapping_per_us": 5.0}
TRAPPED = SimulationSettings(dt_ns=1, length_ns=2400, diffusion=False, cloud_fwhm_mm=0)
PATHS = SimulationSettings(dt_ns=1, length_ns=3000)
component = st.floats(-4000, 4000, allow_nan=False)


def siggen(folder: Path, kind: str) -> dict[str, np.ndarray]:
    """Pulses of the reference, with places and clouds."""
    with np.load(folder / "siggen" / f"waveforms_{kind}_A_outertaper_grid0.1.npz") as data:
        return dict(data)


def of(fields: FieldMaps, settings: SimulationSettings) -> Simulator:
    return Simulator(ICPC, settings, fields=fields)


@given(st.floats(0, 18), st.floats(0, 6.28), st.floats(2.5, 11.5))
@settings(max_examples=25)
def test_charge_is_conserved_and_quarter_turns_change_nothing(
    planar: FieldMaps, r: float, phi: float, z: float
) -> None:
    x, y = r * np.cos(phi), r * np.sin(phi)
    kind = SIGGEN.model_copy(update={"dt_ns": 16.0})
    signals = of(planar, kind).signals([x, -y, x], [y, x, -y], [z] * 3, 500.0)
    assert np.allclose(signals.waveforms[:, -1], 1, atol=1e-4)
    assert np.all(np.diff(signals.waveforms, axis=1) > -1e-6)
    np.testing.assert_allclose(signals.waveforms[1:], signals.waveforms[[0, 0]], atol=1e-6)


def test_self_repulsion_and_diffusion_widen_the_cloud(planar: FieldMaps) -> None:
    def width(energy_kev: float = 10.0, **values: object) -> float:
        simulator = of(planar, SimulationSettings(**values))  # type: ignore[arg-type]
        return float(simulator.signals(0.0, 0.0, 9.0, energy_kev).cloud_fwhm_ns[0])

    # kT/e is 0.078 V mm/cm at 90 K; siggen counts up the cloud's duration
    constants = (width(diffusion_constant=c) for c in ("temperature", 0.12, "siggen"))
    widths = [width(diffusion=False), *constants]
    assert np.all(np.diff(widths) > 0)
    assert widths[2] <= width(self_repulsion=True) < width(2000.0, self_repulsion=True)


def test_a_bad_hit_is_named(planar: FieldMaps) -> None:
    with pytest.raises(CpunetError, match="hit 1: no finite place"):
        of(planar, PLAIN).signals([0, np.nan], 0.0, 5.0, 1.0)


def test_reference_pulses(reference_data: Path, reference_maps: FieldMaps) -> None:
    data = siggen(reference_data, "plain")
    start, expected = data["positions"], data["wf1"]
    signals = of(reference_maps, PLAIN).signals(*start.T, 100.0)
    assert signals.valid.all()
    assert signals.collected.all()
    worst = np.abs(signals.waveforms - expected).max(axis=1)
    assert np.median(worst) < 3e-4
    # the others start beside the contact or end at its corner, between nodes 0.5 mm apart
    assert (worst < 1e-3).sum() >= 192


@pytest.mark.thorough
def test_pulses_in_own_fields_agree_with_the_reference(reference_data: Path) -> None:
    data = siggen(reference_data, "plain")
    start, expected = data["positions"], data["wf1"]
    signals = Simulator(ICPC, PLAIN).signals(*start.T, 100.0)
    collected = [np.argmax(w > 0.995, axis=1) for w in (signals.waveforms, expected)]
    assert np.abs(np.subtract(*collected)).max() <= 1
    assert np.sqrt(np.mean((signals.waveforms - expected) ** 2, axis=1)).max() < 2e-3


def test_reference_clouds(reference_data: Path, reference_maps: FieldMaps) -> None:
    data = siggen(reference_data, "diffusion")
    start, expected, steps = data["positions"], data["wf1"], data["fwhm_steps"]
    signals = of(reference_maps, SIGGEN).signals(*start.T, 100.0)
    # whole steps: one off is rounding
    assert np.abs(signals.cloud_fwhm_ns - steps).max() <= 1
    assert (np.abs(signals.cloud_fwhm_ns / steps - 1) < 0.05).mean() > 0.9
    assert np.sqrt(np.mean((signals.waveforms - expected) ** 2, axis=1)).max() < 3e-3
    strong = SIGGEN.model_copy(update={"self_repulsion": True})
    widths = of(reference_maps, strong).signals(*start.T, 2000.0).cloud_fwhm_ns
    assert np.abs(widths - data["fwhm_steps_ene2000"]).max() <= 1


def hecht(t_ns: Array, path_mm: float, carrier: int, rate_per_us: float) -> Array:
    """Signal (of full scale) of a carrier that drifts `path_mm` of 10 mm at 1000 V/cm."""
    speed = abs(carrier_velocity(*TABLE, carrier, 0.0, 0.0, -1000.0)[2])
    rate = rate_per_us / 1000
    return speed / rate / 10 * -np.expm1(-rate * np.minimum(t_ns, path_mm / speed))


@pytest.mark.parametrize("z", [3.0, 8.0, 11.5])
def test_a_uniform_field_follows_hecht(planar: FieldMaps, z: float) -> None:
    trapping = TRAPPED.model_copy(update=RATES)
    signals = of(planar, trapping).signals([0.0], [0.0], [z], [100.0])
    t = np.arange(TRAPPED.n_samples, dtype=float)
    expected = hecht(t, z - 2, HOLE, 2.0) + hecht(t, 12 - z, ELECTRON, 5.0)
    np.testing.assert_allclose(signals.waveforms[0], expected, atol=1e-3)
    assert signals.trapped[0] == pytest.approx(1 - expected[-1], abs=2e-4)
    speeds = [abs(carrier_velocity(*TABLE, c, 0.0, 0.0, -1000.0)[2]) for c in (HOLE, ELECTRON)]
    last = max((z - 2) / speeds[0], (12 - z) / speeds[1])
    assert signals.collection_time_ns[0] == pytest.approx(last, abs=2)


def test_trapped_charge_lowers_the_energy_and_not_the_pulse(planar: FieldMaps) -> None:
    places = [[0.0, 0.0, 4.0], [0.0, 0.0, 10.0], [0.0, 0.0, 0.5]]
    hits = Hits.of(places, [400.0, 600.0, 50.0], [0, 3])
    events = of(planar, TRAPPED.model_copy(update=RATES)).events(hits)
    t = np.array([1e5])
    kept = [hecht(t, z - 2, HOLE, 2.0) + hecht(t, 12 - z, ELECTRON, 5.0) for z in (4.0, 10.0)]
    collected = 400 * kept[0][0] + 600 * kept[1][0]
    assert events.lost_kev[0] == 50
    assert events.trapped_kev[0] == pytest.approx(1000 - collected, abs=0.2)
    assert events.pulses().energy_kev[0] == pytest.approx(collected, abs=0.2)
    assert events.waveforms[0, -1] == pytest.approx(1, abs=1e-4)
    without = of(planar, TRAPPED).events(hits)
    assert without.trapped_kev[0] == 0


def test_an_event_is_the_weighted_sum_of_its_hits(planar: FieldMaps) -> None:
    place = [[1.0, 2.0, 5.0], [6.0, 0.0, 9.0], [0.0, 0.0, 0.5]]
    hits = Hits.of(place, [300.0, 100.0, 50.0], [0, 3, 3])
    simulator = of(planar, SimulationSettings(length_ns=2400))
    events = simulator.events(hits)
    single = simulator.signals(*np.transpose(place), 1.0).waveforms
    both = 0.75 * single[0] + 0.25 * single[1]
    np.testing.assert_allclose(events.waveforms[0], both, atol=1e-6)
    assert events.lost_kev.tolist() == [50.0, 0.0]
    assert events.collected_kev.tolist() == [400.0, 0.0]
    assert events.valid.tolist() == events.collected.tolist() == [True, True, False]
    assert len(events.pulses()) == 1
    assert events.pulses().energy_kev.tolist() == [400.0]


def test_charges_that_come_too_late_are_not_collected(planar: FieldMaps) -> None:
    hits = Hits.of([[0, 0, 2.5], [0, 0, 7]], [100, 100], [0, 1, 2])
    events = of(planar, SimulationSettings(length_ns=64)).events(hits)
    assert events.valid.all()
    assert events.collected.tolist() == [False, True]  # 9.5 mm to the lithium, 5 mm at most
    assert events.waveforms[:, -1] == pytest.approx([0.65, 1], abs=0.1)


def test_holes_slide_along_the_ditch_and_are_not_collected_there() -> None:
    """A surface charge that draws them holds them where the inner wall meets the face."""
    charged = ["surface_charge_1e10_per_cm2=-2", "siggen_conventions=false", "bias_V=9000"]
    detector = read_detector("icpc", [*charged, "grid_mm=0.25"])
    r, z = np.meshgrid(np.arange(6.0, 17.0, 0.5), np.arange(0.5, 8.0, 0.5))
    inside = detector.active(r, z)
    r, z = r[inside], z[inside]
    simulator = Simulator(detector, SimulationSettings(length_ns=1600))
    signals = simulator.signals(r, 0.0, z, 100.0)
    held = ~signals.collected
    assert 5 < held.sum() < len(held) / 5
    assert signals.waveforms[~held, -1].min() > 0.98
    _, holes = simulator.paths(r[held], 0.0, z[held])
    np.testing.assert_allclose(np.hypot(*holes[:, -1, :2].T), 11, atol=0.15)
    np.testing.assert_allclose(holes[:, -1, 2], 0, atol=0.01)
    corner = simulator.fields.weighting_potential[44, 0]  # at 11 mm
    np.testing.assert_allclose(signals.waveforms[held, -1], corner, atol=0.02)


@pytest.mark.usefixtures("own_cache")
@pytest.mark.parametrize(
    "values",
    [
        {"temperature_K": 92.0},
        {"impurity_scale": 1.03},
        {"hole_velocity_low_factor": 0.97},
        {"cloud_fwhm_mm": 0.5},
        {"hole_trapping_per_us": 0.05},
    ],
    ids=lambda values: str(next(iter(values))),
)
def test_quick_differences_are_the_exact_ones(values: dict[str, float]) -> None:
    detector = read_detector("ppc", ["grid_mm=0.5"])
    settings = SimulationSettings(length_ns=1600)
    rng = np.random.default_rng(1)
    size, length = detector.crystal_radius / 1.4, detector.crystal_length
    place = rng.uniform([-size, -size, 0], [size, size, length], (120, 3))
    hits = Hits.of(place, rng.uniform(50, 1000, 120), np.arange(0, 121, 3))

    def change(quick: bool) -> Array:
        other = [
            part.model_copy(update={k: v for k, v in values.items() if hasattr(part, k)})
            for part in (detector, settings)
        ]
        pulses = [
            Simulator(*physics, quick=quick).events(hits).waveforms.astype(float)
            for physics in ((detector, settings), other)
        ]
        # as after the electronics, whose bandwidth sharp edges do not pass
        return gaussian_filter1d(pulses[1] - pulses[0], 24 / settings.dt_ns, axis=1)

    exact = change(quick=False)
    error = np.sqrt(np.mean((change(quick=True) - exact) ** 2) / np.mean(exact**2))
    assert 0 < error < 0.1


def hits_with(counts: list[int], seed: int = 0) -> Hits:
    rng = np.random.default_rng(seed)
    n, offsets = sum(counts), np.concatenate([[0], np.cumsum(counts)])
    place, energy = rng.uniform(0, 10, (n, 3)), rng.uniform(0.1, 900, n)
    return Hits.of(place, energy, offsets, np.arange(len(counts)) * 10)


@given(st.lists(st.integers(0, 5), max_size=8), st.data())
def test_picking_events_keeps_their_hits(counts: list[int], data: st.DataObject) -> None:
    hits = hits_with(counts)
    mask = np.array([data.draw(st.booleans()) for _ in counts], bool)
    picked = hits[mask]
    np.testing.assert_allclose(picked.energy_kev, hits.energy_kev[mask])
    np.testing.assert_array_equal(picked.event_number, hits.event_number[mask])
    np.testing.assert_array_equal(picked.x_mm, hits.x_mm[mask[hits.event_of_hit]])
    both = Hits.concatenate([picked, hits[~mask]])
    assert both.edep_kev.sum() == pytest.approx(hits.edep_kev.sum())
    assert len(both) == len(hits)


@given(st.integers(2, 30), st.integers(0, 10_000), st.floats(0, 20))
def test_the_same_as_single_linkage(n: int, seed: int, distance: float) -> None:
    hits = hits_with([n], seed)
    label = fcluster(linkage(hits.position_mm), distance, criterion="distance")
    truth = np.sort(np.bincount(label, weights=hits.edep_kev)[1:])
    np.testing.assert_allclose(np.sort(merge_hits(hits, distance).edep_kev), truth)


@given(st.lists(st.integers(0, 12), max_size=6), st.floats(0, 50))
def test_energy_and_centre_of_each_event_stay(counts: list[int], distance: float) -> None:
    hits = hits_with(counts)
    merged = merge_hits(hits, distance)
    np.testing.assert_allclose(merged.energy_kev, hits.energy_kev, rtol=1e-12)
    for axis in ("x_mm", "y_mm", "z_mm"):
        before, after = (
            np.bincount(h.event_of_hit, h.edep_kev * getattr(h, axis), minlength=len(counts))
            for h in (hits, merged)
        )
        np.testing.assert_allclose(after, before, rtol=1e-9)
    np.testing.assert_array_equal(merged.event_number, hits.event_number)


def drift_paths(fields: FieldMaps, *places: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    return Simulator(read_detector("icpc"), PATHS, fields=fields).paths(*places)


def drift_velocity(
    table: tuple[np.ndarray, float], fields: npt.ArrayLike, carrier: int
) -> np.ndarray:
    """Velocity vectors (n, 3) for field vectors (n, 3)."""
    rows = np.asarray(fields, float).tolist()
    return np.array([carrier_velocity(*table, carrier, *row)[:3] for row in rows])


@pytest.mark.parametrize("far", [99.0, np.nan, np.inf, -np.inf, 1e300])
def test_nothing_drifts_from_a_contact_or_from_outside(planar: FieldMaps, far: float) -> None:
    paths = drift_paths(planar, [5.0, 5.0, far, 0.0], 0.0, [1.0, 13.0, 8.0, far])
    assert np.isnan(paths).all()
    _, holes = drift_paths(planar, 5.0, 3.0, 8.0)  # a single place is one path
    assert holes.shape == (1, PATHS.n_samples, 3)
    assert np.nanmin(holes[0, :, 2]) == pytest.approx(2, abs=0.1)


def test_reference_paths(reference_data: Path, reference_maps: FieldMaps) -> None:
    with np.load(reference_data / "siggen" / "drift_paths_A_grid0.1.npz") as data:
        start, expected = data["positions"], data["paths"][:, : PATHS.n_samples]
    electrons, holes = drift_paths(reference_maps, *start.T)
    # the reference holds electrons first; it drifted in maps five times finer than these
    holes = np.linalg.norm(holes - expected[..., 3:], axis=2)
    electrons = np.linalg.norm(electrons - expected[..., :3], axis=2)
    assert np.nanmax(holes) < 0.005
    assert np.median(np.nanmax(electrons, axis=1)) < 0.001
    assert np.nanmax(electrons) < 0.1


@pytest.mark.parametrize("temperature", [77, 90])
@pytest.mark.parametrize(("carrier", "name"), [(ELECTRON, "ve"), (HOLE, "vh")])
def test_reference_vectors(
    reference_data: Path, temperature: int, carrier: int, name: str
) -> None:
    with np.load(reference_data / "siggen" / "drift_velocity.npz") as data:
        field, expected = data["E"], data[f"{name}_{temperature}"]
    velocity = drift_velocity(velocity_table(temperature), field, carrier)
    np.testing.assert_allclose(velocity, expected, atol=3e-7)


@given(component, component, component)
def test_cubic_symmetry(x: float, y: float, z: float) -> None:
    table = velocity_table(90)
    for carrier in (ELECTRON, HOLE):
        vx, vy, vz = drift_velocity(table, [[x, y, z]], carrier)[0]
        turned = drift_velocity(table, [[-y, x, z], [y, z, x], [x, y, -z]], carrier)
        expected = [[-vy, vx, vz], [vy, vz, vx], [vx, vy, -vz]]
        np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_factors_hold_below_and_above_and_change_smoothly_in_between() -> None:
    factors = {"hole_velocity_low_factor": 0.9, "hole_velocity_high_factor": 1.2}
    own, scaled = velocity_table(90), velocity_table(90, PATHS.model_copy(update=factors))
    directions = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1]]) / np.sqrt([[1], [2], [3]])
    for strength, factor in ((100.0, 0.9), (500.0, 1.05), (2000.0, 1.2)):
        for direction in directions:
            field = strength * direction[None]
            ratio = drift_velocity(scaled, field, HOLE) @ direction
            ratio = ratio / (drift_velocity(own, field, HOLE) @ direction)
            assert ratio == pytest.approx(factor, rel=1e-9)
            electrons = (drift_velocity(table, field, ELECTRON) for table in (scaled, own))
            np.testing.assert_array_equal(*electrons)
    ratio = scaled[0][HOLE, 1:, V100] / own[0][HOLE, 1:, V100]  # at equidistant fields
    assert np.diff(ratio).min() >= -1e-12
    assert np.abs(np.diff(ratio)).max() < 0.1
