"""Which energies belong to which gamma line."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpunet.errors import CpunetError
from cpunet.pulses.peaks import label_peaks, parse_selection
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import PeakConfig

LINES = {
    "FEP": PeakConfig(energy_kev=2614.511, half_width_kev=5),
    "SEP": PeakConfig(energy_kev=2103.511, half_width_kev=5),
    "DEP": PeakConfig(energy_kev=1592.511, half_width_kev=5),
}

lines = st.dictionaries(
    st.sampled_from("ABCDE"),
    st.builds(PeakConfig, energy_kev=st.floats(1, 3000), half_width_kev=st.floats(0.1, 1000)),
)
energies = st.lists(st.floats(allow_nan=True, allow_infinity=True, width=32), max_size=20)


@given(energies, lines)
def test_the_nearest_line_whose_window_covers_wins(values, peaks):
    labels = label_peaks(values, peaks)
    for energy, label in zip(values, labels, strict=True):
        covering = {
            name: abs(energy - peak.energy_kev)
            for name, peak in peaks.items()
            if abs(energy - peak.energy_kev) <= peak.half_width_kev
        }
        if covering:
            assert covering[label] == min(covering.values())
        else:
            assert label == ""


@given(energies, st.integers(0, 3000), st.integers(1, 500))
def test_neighbouring_ranges_share_nothing_and_miss_nothing(values, low, width):
    middle, high = low + width, low + 2 * width
    parts = [
        parse_selection(f"{a}-{b}", {}).select(values)
        for a, b in ((low, middle), (middle, high))
    ]
    whole = parse_selection(f"{low}-{high}", {}).select(values)
    assert not (parts[0] & parts[1]).any()
    assert ((parts[0] | parts[1]) == whole).all()


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


@pytest.mark.parametrize("text", ["fep", "", "FEP,", "-300", "300", "a-b", "nan-", "1-2-3"])
def test_what_is_neither_line_nor_range_is_refused(text):
    with pytest.raises(CpunetError, match=r"no known peak \(FEP, SEP, DEP\)[^\n]*300-3000"):
        parse_selection(text, LINES)


def test_empty_ranges_are_refused():
    with pytest.raises(CpunetError, match="'3000-300' is empty; give the lower end first"):
        parse_selection("3000-300", LINES)


def test_lines_in_ranges_are_those_not_chosen_by_name() -> None:
    peaks = load_recipe("fast").peaks
    assert parse_selection("300-", peaks).lines_in_ranges == ["FEP", "SEP", "DEP"]
    assert parse_selection("FEP,1000-1580,1620-2080", peaks).lines_in_ranges == []
    assert parse_selection("FEP,DEP,1500-2700", peaks).lines_in_ranges == ["SEP"]
