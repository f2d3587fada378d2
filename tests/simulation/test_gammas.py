"""The built-in gamma transport against Geant4 and against textbook limits."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.simulation.clustering import cluster_hits
from cpunet.simulation.gammas import (
    TL208_KEV,
    GammaStatistics,
    WantedLine,
    simulate_gammas,
    with_resolution,
)
from cpunet.simulation.gammas.germanium import electron_table, photon_table
from cpunet.simulation.gammas.processes import compton_energy
from cpunet.simulation.gammas.shape import CrystalShape, in_germanium
from cpunet.simulation.hits import Hits


@dataclass(frozen=True)
class Crystal:
    """The crystal of the Geant4 reference: a cylinder with a bore."""

    crystal_length: float = 96.0
    crystal_radius: float = 40.5
    bore_length: float = 69.9
    bore_radius: float = 5.0
    bore_bullet_radius: float = 0.0
    outer_taper_length: float = 0.0
    inner_taper_length: float = 0.0
    taper_angle_deg: float = 0.0
    wrap_around_radius: float = 14.0
    ditch_depth: float = 0.0
    ditch_thickness: float = 3.0


LINES = {
    "DEP": WantedLine(1591.0, 1594.0, 1500),
    "SEP": WantedLine(2102.0, 2105.0, 800),
    "FEP": WantedLine(2613.5, 2615.5, 800),
}
# Geant4 11.4, option0: hit, FEP, SEP, DEP per gamma in the cone
GEANT4 = {20: (0.4265, 0.0997, 0.01131, 0.00370), 100: (0.4450, 0.1101, 0.01199, 0.00386)}


def run(height: float, n: int, seed: int = 3, **more: object) -> tuple[Hits, GammaStatistics]:
    return simulate_gammas(
        Crystal(),
        source_height_mm=height,
        source_radius_mm=5,
        n_primaries=n,
        seed=seed,
        **more,  # type: ignore[arg-type]
    )


# one keV bin of a window that keeps no event, so that only the statistics cost memory
NONE = {"none": WantedLine(2613.0, 2613.1, 10**9)}


def counted(height: float, n: int) -> GammaStatistics:
    """Statistics alone, of blocks small enough not to fill the memory with hits."""
    blocks = [run(height, n // 8, seed)[1] for seed in range(8)]
    return GammaStatistics(
        sum(b.n_primaries for b in blocks), np.sum([b.spectrum for b in blocks], axis=0)
    )


@pytest.mark.parametrize("height", [20, 100])
def test_lines_agree_with_geant4(height: int) -> None:
    seen = counted(height, 480_000)

    def peak(low: int, high: int) -> float:
        beside = seen.fraction(low - 7, low - 1) + seen.fraction(high + 1, high + 7)
        return seen.fraction(low, high) - beside / 12 * (high - low)

    measured = (
        seen.hit_fraction,
        seen.fraction(2613, 2616),
        peak(2102, 2105),
        peak(1591, 1594),
    )
    # 5 %, and two standard deviations of the counts of a line
    for value, truth in zip(measured, GEANT4[height], strict=True):
        assert value == pytest.approx(truth, rel=0.05 + 2 / np.sqrt(truth * 480_000))


def test_spectrum_agrees_with_geant4(reference_data: Path) -> None:
    with np.load(reference_data / "geant4" / "spectrum_g4_h20mm.npz") as file:
        truth, n = file["counts"], int(file["N"])
    seen = counted(20, 160_000)
    edges = [50, 250, 500, 1000, 1500, 1800, 2090, 2120, 2350, 2500, 2610]
    for low, high in itertools.pairwise(edges):
        expected = truth[low:high].sum() / n
        error = np.sqrt(1 / (expected * 160_000))
        assert seen.fraction(low, high) == pytest.approx(expected, rel=0.05 + 3 * error)


def test_sites_agree_with_geant4() -> None:
    hits, _ = run(20, 3_000_000, wanted=LINES)
    sites = cluster_hits(hits, 1.5)
    large = sites.where(sites.edep_kev > 5)
    count = np.bincount(large.event_of_hit, minlength=large.n_events)
    energy = hits.energy_kev
    dep, sep, fep = energy < 1600, (energy > 2100) & (energy < 2110), energy > 2610
    assert np.mean(count[dep] == 1) == pytest.approx(0.88, abs=0.03)
    assert count[sep].mean() == pytest.approx(4.0, rel=0.05)
    assert count[fep].mean() == pytest.approx(4.2, rel=0.05)


def test_hits_lie_in_germanium_and_never_exceed_the_line() -> None:
    hits, seen = run(20, 5_000)
    shape = CrystalShape.of(Crystal())
    assert all(
        in_germanium(shape, *place)
        for place in hits.position_mm[:: max(len(hits.edep_kev) // 3000, 1)]
    )
    assert hits.energy_kev.max() <= TL208_KEV + 1e-6
    assert hits.n_events == seen.spectrum.sum()


def test_the_same_seed_gives_the_same_events() -> None:
    first, second, other = run(20, 3_000)[0], run(20, 3_000)[0], run(20, 3_000, seed=4)[0]
    np.testing.assert_array_equal(first.x_mm, second.x_mm)
    np.testing.assert_array_equal(first.event_number, second.event_number)
    assert len(other.x_mm) != len(first.x_mm)


def test_wanted_counts_are_met_exactly() -> None:
    wanted = {"FEP": LINES["FEP"]._replace(events=50), "low": WantedLine(100, 600, 20)}
    hits, seen = run(100, 100_000, wanted=wanted)
    energy = hits.energy_kev
    assert np.sum(energy > 2600) == 50
    assert np.sum(energy < 700) == 20
    assert seen.n_primaries < 10_000


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"height": -1.0, "n": 10}, "not above the crystal"),
        ({"height": 20, "n": 0}, "give at least 1"),
        ({"height": 20, "n": 10, "energy_kev": 9e3}, "tables hold"),
        ({"height": 20, "n": 10, "wanted": NONE}, "10 gammas were not enough"),
        ({"height": 20, "n": 10, "wanted": {"a": WantedLine(9, 2, 1)}}, "a: window"),
    ],
)
def test_impossible_wishes_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(CpunetError, match=message):
        run(**settings)  # type: ignore[arg-type]


def test_electron_range_and_photon_attenuation() -> None:
    table = electron_table()
    reach = np.interp(1.0, table.energy[::-1], table.range[::-1])
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


def test_tapers_bore_and_ditch_are_cut_out() -> None:
    shape = CrystalShape.of(
        Crystal(
            bore_bullet_radius=5,
            outer_taper_length=35,
            inner_taper_length=20,
            taper_angle_deg=10,
            ditch_depth=2,
        )
    )
    inside = {(0, 20): True, (0, 26.2): False, (4.5, 26.2): True, (4.5, 50): False}
    inside |= {(12, 1): False, (12, 2.5): True, (15, 1): True, (40, 50): True, (40, 90): False}
    inside |= {(8, 95): False, (9, 95): True, (10, 96.1): False, (10, -0.1): False}
    for (r, z), truth in inside.items():
        assert in_germanium(shape, r, 0.0, z) is truth, (r, z)


def test_resolution_has_the_width_asked_for() -> None:
    energy = with_resolution(np.full(40_000, 2614.5), noise_kev2=1.0, fano_kev=0.002, seed=1)
    assert energy.std() * 2.3548 == pytest.approx(np.sqrt(1 + 0.002 * 2614.5), rel=0.02)
    with pytest.raises(CpunetError, match="numbers from 0 up"):
        with_resolution([1.0], noise_kev2=-1, fano_kev=0, seed=1)
