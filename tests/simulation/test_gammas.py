"""The built-in gamma transport against Geant4 and against textbook limits."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from cpunet.errors import CpunetError
from cpunet.simulation.gamma_tables import electron_table, photon_table
from cpunet.simulation.gammas import (
    HITS,
    LOST,
    TL208_KEV,
    EnergyWindow,
    Event,
    Medium,
    UnitVector,
    compton_energy,
    follow_photons,
    put_photon,
    simulate_gammas,
)
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import detector_names, read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.outline import outline_of
from cpunet.simulation.simulator import merge_hits

FEP = EnergyWindow("FEP", 2613.5, 2615.5)
DEP, SEP = EnergyWindow("DEP", 1591.0, 1594.0), EnergyWindow("SEP", 2102.0, 2105.0)
LINES = {DEP: 1500, SEP: 800, FEP: 800}
# Geant4 11.4, option0: hit, FEP, SEP, DEP per gamma in the cone
GEANT4 = {20: (0.4265, 0.0997, 0.01131, 0.00370), 100: (0.4450, 0.1101, 0.01199, 0.00386)}


def crystal(**changed: float) -> Detector:
    """The crystal of the Geant4 reference: a cylinder with a bore."""
    values: dict[str, float] = {
        "crystal_length": 96.0, "crystal_radius": 40.5, "bore_length": 69.9, "bore_radius": 5.0,
        "wrap_around_radius": 14.0, "point_contact_length": 2.0, "point_contact_radius": 2.3,
        "li_thickness": 1.0, "impurity_z0_1e10_per_cm3": -1.8, "bias_V": 4000.0,
        "temperature_K": 90.0,
    }  # fmt: skip
    return Detector.model_validate(values | changed)


def run(height: float, n: int, seed: int = 3, **more: object) -> tuple[Hits, int]:
    how = {"source_height_mm": height, "source_radius_mm": 5, "n_primaries": n, "seed": seed}
    return simulate_gammas(crystal(), **how, **more)  # type: ignore[arg-type]


def spectrum(height: float, n: int) -> npt.NDArray[np.float64]:
    """Events per gamma and keV, of blocks small enough not to fill the memory with hits."""
    energies = (run(height, n // 64, seed)[0].energy_kev for seed in range(64))
    return np.sum([np.histogram(e, np.arange(2617))[0] for e in energies], axis=0) / n


@pytest.mark.parametrize("height", [20, pytest.param(100, marks=pytest.mark.thorough)])
def test_lines_and_spectrum_agree_with_geant4(reference_data: Path, height: int) -> None:
    n = 480_000
    seen = spectrum(height, n)

    def peak(low: int, high: int) -> float:
        beside = seen[low - 7 : low - 1].sum() + seen[high + 1 : high + 7].sum()
        return float(seen[low:high].sum() - beside / 12 * (high - low))

    measured = seen.sum(), seen[2613:2616].sum(), peak(2102, 2105), peak(1591, 1594)
    # 5 %, and two standard deviations of the counts of a line
    for value, truth in zip(measured, GEANT4[height], strict=True):
        assert value == pytest.approx(truth, rel=0.05 + 2 / np.sqrt(truth * n))
    if height == 20:
        with np.load(reference_data / "geant4" / "spectrum_g4_h20mm.npz") as file:
            truth = file["counts"] / int(file["N"])
        edges = [50, 250, 500, 1000, 1500, 1800, 2090, 2120, 2350, 2500, 2610]
        for low, high in itertools.pairwise(edges):
            expected = truth[low:high].sum()
            error = np.sqrt(1 / (expected * n))
            assert seen[low:high].sum() == pytest.approx(expected, rel=0.05 + 3 * error)


@pytest.mark.thorough
def test_sites_agree_with_geant4() -> None:
    hits, _ = run(20, 3_000_000, wanted=LINES)
    sites = merge_hits(hits, 1.5)
    count = np.bincount(sites.event_of_hit[sites.edep_kev > 5], minlength=len(sites))
    energy = hits.energy_kev
    dep, sep, fep = energy < 1600, (energy > 2100) & (energy < 2110), energy > 2610
    assert np.mean(count[dep] == 1) == pytest.approx(0.88, abs=0.03)
    assert count[sep].mean() == pytest.approx(4.0, rel=0.05)
    assert count[fep].mean() == pytest.approx(4.2, rel=0.05)


# each shape has something at both ends, with walls beside the grid's lines
SHAPES: dict[str, Detector] = {name: read_detector(name) for name in detector_names()} | {
    "bullets": crystal(top_bullet_radius=6, bottom_bullet_radius=9, bore_bullet_radius=3),
    "tapers": crystal(
        outer_taper_length=60, taper_angle_deg=12, inner_taper_length=69.9,
        inner_taper_angle_deg=5, bore_bullet_radius=4.5, bottom_taper_length=11,
        bottom_taper_angle_deg=35,
    ),
    "ditch": crystal(
        ditch_depth=3.3, ditch_thickness=5.5, bottom_bullet_radius=7, outer_taper_length=30,
        taper_angle_deg=8, siggen_conventions=False,
    ),
    "cylinders": crystal(
        top_cylinder_length=20, top_cylinder_radius=33, bottom_cylinder_length=25,
        bottom_cylinder_radius=36, bottom_transition_length=6, top_groove_depth=9,
        top_groove_radius=19, bottom_taper_length=4,
    ),
    "low": crystal(
        crystal_length=30, bore_length=0, bore_radius=0, ditch_depth=2, ditch_thickness=3,
        top_bullet_radius=4, bottom_taper_length=5, bottom_taper_angle_deg=60, grid_mm=0.5,
    ),
}  # fmt: skip


@pytest.mark.parametrize("detector", SHAPES.values(), ids=SHAPES)
def test_no_hit_lies_outside_its_detector(detector: Detector) -> None:
    for height in (1.0, 80.0):
        source = {"source_height_mm": height, "source_radius_mm": 20}
        hits, _ = simulate_gammas(detector, **source, n_primaries=20_000, seed=7)
        assert len(hits.edep_kev) > 100_000
        assert hits.energy_kev.max() <= TL208_KEV + 1e-6
        assert detector.inside(np.hypot(hits.x_mm, hits.y_mm), hits.z_mm).all()


def test_impossible_wishes_are_refused() -> None:
    wishes = {FEP: "10 gammas were not enough", EnergyWindow("a", 9, 2): "a: window"}
    for window, message in wishes.items():
        with pytest.raises(CpunetError, match=message):
            run(20, 10, wanted={window: 10**9})


def test_electron_range_and_photon_attenuation() -> None:
    table = electron_table()
    reach = np.interp(1.0, table.energy[::-1], np.cumsum(table.step[::-1]))
    # NIST ESTAR: 1.23 mm, which counts losses to hard photons too
    assert reach == pytest.approx(1.23, rel=0.06)
    photons = photon_table()
    at = int((np.log(2.6145) - photons.log_first) * photons.per_log)
    # XCOM without coherent scattering, cm2/g
    xcom = 0.03317492 + 0.000133339 + 0.003371496 + 3.236e-6
    assert photons.attenuation_per_mm[at] * 10 / 5.323 == pytest.approx(xcom, rel=2e-3)


def test_compton_mean_energy_is_that_of_klein_and_nishina() -> None:
    rng = np.random.default_rng(0)
    drawn = np.mean([compton_energy(1.0, rng) for _ in range(20_000)])
    k = 1 / 0.510998950
    cosine = np.linspace(-1, 1, 20_001)
    share = 1 / (1 + k * (1 - cosine))
    weight = share**2 * (share + 1 / share - 1 + cosine**2)
    assert drawn == pytest.approx(np.sum(weight * share) / weight.sum(), rel=0.01)


def test_deposits_for_which_there_is_no_room_are_counted() -> None:
    medium = Medium(outline_of(crystal()), photon_table(), electron_table())
    counts = []
    for room in (3, 2000):
        event = Event(np.empty((room, 4)), np.empty((256, 7)), np.zeros(3, np.int64))
        put_photon(event, 20.0, 0.0, 50.0, UnitVector(0.0, 0.0, -1.0), 2.6145)
        follow_photons(medium, event, np.random.default_rng(1))
        counts.append(event.counts)
    few, all_of_them = counts
    assert few[HITS] == 3 < all_of_them[HITS]
    assert few[LOST] == all_of_them[HITS] - 3
    assert all_of_them[LOST] == 0
