"""Which pulses are taken: by the line that they belong to, and by quality cuts."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpunet.errors import CpunetError
from cpunet.pulses.peaks import label_peaks, parse_selection
from cpunet.pulses.preparation import Prepared, apply_cuts, fit_cuts
from cpunet.recipes.schema import CutConfig, PeakConfig
from synthetic import load_recipe, prepared_of

CUTS = CutConfig(decay_sigmas=6.0, chi2_sigmas=6.0, baseline_sigmas=6.0)
Array = npt.NDArray[np.float64]
KEV = {"FEP": 2614.511, "SEP": 2103.511, "DEP": 1592.511}
LINES = {name: PeakConfig(energy_kev=kev, half_width_kev=5) for name, kev in KEV.items()}

lines = st.dictionaries(
    st.sampled_from("ABCDE"),
    st.builds(PeakConfig, energy_kev=st.floats(1, 3000), half_width_kev=st.floats(0.1, 1000)),
)
energies = st.lists(st.floats(allow_nan=True, allow_infinity=True, width=32), max_size=20)


@given(energies, lines)
def test_the_nearest_line_whose_window_covers_wins(values, peaks):
    for energy, label in zip(values, label_peaks(values, peaks), strict=True):
        away = {name: abs(energy - peak.energy_kev) for name, peak in peaks.items()}
        covering = {n: away[n] for n, peak in peaks.items() if away[n] <= peak.half_width_kev}
        assert covering[label] == min(covering.values()) if covering else label == ""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("FEP", [0, 0, 0, 1, 0]),
        ("SEP, DEP", [0, 1, 1, 0, 0]),
        ("300-", [0, 1, 1, 1, 0]),
        ("1e3-2.0e3", [0, 1, 0, 0, 0]),
        ("FEP,100 - 200", [1, 0, 0, 1, 0]),
    ],
)
def test_selections(text, expected):
    values = [150.0, 1592.0, 2103.0, 2614.0, np.nan]
    selection = parse_selection(text, LINES)
    assert selection.name == text
    assert selection.select(values).astype(int).tolist() == expected


@pytest.mark.parametrize(
    "text", ["fep", "", "FEP,", "-300", "300", "a-b", "nan-", "1-2-3", "3000-300"]
)
def test_what_is_neither_line_nor_range_is_refused(text):
    said = r"no known peak \(FEP, SEP, DEP\)[^\n]*300-3000"
    said = "'3000-300' is empty; give the lower end first" if text == "3000-300" else said
    with pytest.raises(CpunetError, match=said):
        parse_selection(text, LINES)


def test_lines_in_ranges_are_those_not_chosen_by_name() -> None:
    peaks = load_recipe("fast").peaks
    assert parse_selection("300-", peaks).lines_in_ranges == ["FEP", "SEP", "DEP"]
    assert parse_selection("FEP,1000-1580,1620-2080", peaks).lines_in_ranges == []
    assert parse_selection("FEP,DEP,1500-2700", peaks).lines_in_ranges == ["SEP"]


def pulse(start: float, tau_samples: float = 3750.0) -> Array:
    t = np.maximum(np.arange(1200) - start, 0)
    return np.asarray((1 - np.exp(-((t / 20) ** 2))) * np.exp(-t / tau_samples))


def traces(amplitudes: Array, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, 10, (len(amplitudes), 1200))
    offsets = rng.normal(14_000, 30, (len(amplitudes), 1))
    return np.asarray(offsets + amplitudes[:, None] * pulse(560) + noise)


@pytest.fixture(scope="module")
def spoiled() -> Prepared:
    """Five hundred clean pulses of all energies and five outliers at known rows."""
    rng = np.random.default_rng(3)
    raw = traces(rng.uniform(2_000, 40_000, 500))
    raw[10] += 3_000 * np.exp(-np.arange(1200) / 3750)  # on the tail of an earlier pulse
    raw[20] += 1_000 * pulse(260)  # pile-up in the baseline window
    raw[30] += 500 * pulse(800)  # pile-up on the tail, too small to move the maximum
    raw[40] += 900  # another baseline level
    raw[50, 560:] = 14_000 + 20_000 * pulse(560, 3000)[560:]  # another decay
    return prepared_of(raw)


def test_outliers_are_found_and_clean_pulses_stay(spoiled: Prepared) -> None:
    cut = apply_cuts(spoiled, fit_cuts(spoiled, CUTS))
    assert set(spoiled.index) - set(cut.index) == {10, 20, 30, 40, 50}
    assert set(cut.rejections) <= {"tail_slope", "chi2", "baseline", "baseline_slope"}
    assert len(cut) + sum(cut.rejections.values()) == cut.n_read == 500


def test_pulses_without_noise_lose_nothing() -> None:
    prepared = prepared_of(np.linspace(1_000, 2_000, 50)[:, None] * pulse(560))
    assert len(apply_cuts(prepared, fit_cuts(prepared, CUTS))) == 50


def test_too_few_pulses_draw_no_windows() -> None:
    few = prepared_of(traces(np.full(9, 20_000.0)))
    assert fit_cuts(few, CUTS).windows == ()
    assert apply_cuts(few, fit_cuts(few, CUTS)) is few


@pytest.mark.parametrize("name", ["closure", "closure-shifted"])
def test_known_contamination(name: str, reference_data: Path) -> None:
    with h5py.File(reference_data / name / "data.lh5") as file:
        raw = file["geds/raw/waveform/values"][:]
    flag = np.load(reference_data / name / "data_labels.npz")["flag"]
    prepared = prepared_of(raw)
    cut = apply_cuts(prepared, fit_cuts(prepared, CUTS))
    kept = np.isin(np.arange(len(raw)), cut.index)
    assert kept[flag == 0].mean() > 0.995
    assert (~kept[flag == 1]).mean() > 0.7  # decaying baselines
    # A third of the pile-up is outside the window or within the charge collection, and
    # what begins shortly before a pulse cannot be told from a slow one: 23 of 41 are found.
    assert (~kept[flag == 2]).mean() > 0.5


def test_slow_pulses_are_not_taken_for_sloping_baselines() -> None:
    rng = np.random.default_rng(5)
    rise = np.clip((np.arange(1200)[None] - 500) / rng.uniform(60, 260, 600)[:, None], 0, 1)
    # slowest at first, as charge is that starts far from the contact: begins in the window's
    # baseline part if it takes more than 200 samples
    raw = 15_000 + 25_000 * rise**2 + rng.normal(0, 20, rise.shape)
    kept = apply_cuts(prepared := prepared_of(raw), fit_cuts(prepared, CUTS))
    assert kept.rejections.get("baseline_slope", 0) <= 2
