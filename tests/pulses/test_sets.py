"""Prepared sets from sources: selection, counting, streaming, and one-line errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cpunet.errors import CpunetError
from cpunet.pulses import sets
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.arrays import MemorySource
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.sets import load_prepared
from cpunet.recipes.schema import PreparationConfig

CONFIG = PreparationConfig(
    samples_before=20,
    samples_after=20,
    align_fraction=0.999,
    baseline_samples=10,
    tail_samples=2,
    tail_level=0.80,
    decay_fit_samples=10,
    max_padding_before=5,
    max_padding_after=0,
    saturation_run=4,
)


def source_of(energies: npt.ArrayLike, broken: list[int] | None = None) -> MemorySource:
    energy_kev = np.asarray(energies, float)
    t = np.maximum(np.arange(60) - 27, 0)
    raw = (
        np.nan_to_num(energy_kev, nan=500.0)[:, None] * np.minimum(t / 5, 1) * np.exp(-t / 300)
    )
    raw[broken or []] = np.nan
    pulses = Pulses.of(raw, dt_ns=16, energy_kev=energy_kev)
    return MemorySource(PulseFile(Path("run7.lh5")), pulses)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sets, "BLOCK_SIZE", 4)


def near_1000(energy_kev: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    return abs(energy_kev - 1000) < 100


def test_every_pulse_is_kept_or_counted() -> None:
    energies = [1000, 1001, 50, np.nan, 1002, 1003, 2000, 999, 998, np.nan]
    prepared = load_prepared(source_of(energies, [4]), CONFIG, "measured", select=near_1000)
    assert prepared.pulses.energy_kev.tolist() == [1000, 1001, 1003, 999, 998]
    assert prepared.index.tolist() == [0, 1, 5, 7, 8]
    assert prepared.rejections == {"nan": 1, "energy_unknown": 2, "energy_outside_selection": 2}
    assert prepared.n_read == 10


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.sampled_from([1000.0, 50.0, np.nan]), min_size=1, max_size=20),
    st.integers(1, 20),
)
def test_counts_add_up(energies: list[float], max_pulses: int) -> None:
    source = source_of([*energies, 1000.0])
    prepared = load_prepared(
        source, CONFIG, "measured", select=near_1000, max_pulses=max_pulses
    )
    assert len(prepared) + sum(prepared.rejections.values()) == prepared.n_read
    assert prepared.n_read == len(energies) + 1
    assert len(prepared) == min(max_pulses, energies.count(1000.0) + 1)
    assert (source.read().energy_kev[prepared.index] == 1000).all()


def test_of_too_many_a_sample_of_the_whole_file_is_kept() -> None:
    source = source_of([1000.0, 50.0] * 500)
    first, second = (
        load_prepared(source, CONFIG, "measured", select=near_1000, max_pulses=60)
        for _ in range(2)
    )
    assert (len(first), first.n_read) == (60, 1000)
    assert first.rejections == {"energy_outside_selection": 500, "not_drawn": 440}
    assert (first.index == second.index).all()
    assert (np.diff(first.index) > 0).all()
    # rows 0, 2 ... 998, each as likely: their mean is 499 with a scatter of 289 / sqrt(60)
    assert abs(first.index.mean() - 499) < 3 * 289 / 60**0.5
    assert (first.codes[first.index] == 0).all()
    whole = load_prepared(source, CONFIG, "measured", select=near_1000)
    same = np.isin(whole.index, first.index)
    assert (whole.pulses.waveforms[same] == first.pulses.waveforms).all()


@pytest.mark.parametrize(
    ("energies", "broken", "words"),
    [
        ([], [], ["run7.lh5", "no pulses"]),
        ([50.0] * 9, [], ["9 energy_outside_selection", "calibration"]),
        (
            [1000.0] * 5 + [50.0],
            [0, 1, 2, 3, 4],
            ["5 nan, 1 energy_outside", "write them again"],
        ),
        ([np.nan] * 3, [], ["3 energy_unknown", "calibrated energies"]),
    ],
)
def test_nothing_left_is_one_line_with_counts_and_remedy(
    energies: list[float], broken: list[int], words: list[str]
) -> None:
    with pytest.raises(CpunetError) as error:
        load_prepared(source_of(energies, broken), CONFIG, "measured", select=near_1000)
    message = str(error.value)
    assert "\n" not in message
    assert all(word in message for word in words), message
