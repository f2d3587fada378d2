"""Files of realistic libraries: mixtures, groups, and parts that are not as expected."""

from __future__ import annotations

from pathlib import Path

import h5py
import lh5
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.legend.low_rank import Loss
from cpunet.legend.peak_currents import LENGTH, PEAK
from cpunet.legend.realistic_library import (
    Made,
    describe,
    expand_library,
    merge_libraries,
    read_library,
)

R, Z = np.arange(2.0), np.arange(3.0)
BASIS = np.eye(2, LENGTH, PEAK, dtype=np.float32)  # two samples
CURRENTS = np.arange(1, 13, dtype=np.float32).reshape(2, 3, 2) @ BASIS


def put(path: Path, name: str, *, components: bool) -> Path:
    with h5py.File(path, "a") as file:
        group = file.create_group(name)
        made = Made.begin(group, R, Z, 1.0, BASIS if components else None)
        arrays = made.angle("000_deg")
        arrays.put(slice(0, 2), CURRENTS, Loss())
        arrays.put_times(np.ones((2, 3)))
        group.attrs["cpunet"] = "{}"
        describe(group)
    return path


def test_whole_libraries_stay_beside_expanded_ones(tmp_path: Path) -> None:
    source = put(tmp_path / "mixed.lh5", "V01", components=True)
    put(source, "B02", components=False)
    assert expand_library(source, tmp_path / "whole.lh5") == ["B02", "V01"]
    for name in ("B02", "V01"):
        library = read_library(tmp_path / "whole.lh5", name)
        assert library.rank is None
        np.testing.assert_array_equal(library.currents(), CURRENTS)


def test_groups_about_libraries_are_read_by_lh5(tmp_path: Path) -> None:
    sources = [
        put(tmp_path / f"{name}.lh5", f"geds/{name}", components=False) for name in ("a", "b")
    ]
    merge_libraries(sources, tmp_path / "psl.lh5")
    assert set(lh5.read("geds", str(tmp_path / "psl.lh5"))) == {"a", "b"}


def test_a_period_in_a_column(tmp_path: Path) -> None:
    source = put(tmp_path / "psl.lh5", "V01", components=True)
    with h5py.File(source, "a") as file:
        del file["V01/dt"]
        file["V01/dt"] = np.array([1.0])
        file["V01"].attrs["cpunet"] = 3.0  # no JSON of how it was made
    assert read_library(source).dt_ns == 1
    assert read_library(source).told == {}
    assert expand_library(source, tmp_path / "whole.lh5") == ["V01"]


def test_several_periods_make_no_library(tmp_path: Path) -> None:
    source = put(tmp_path / "psl.lh5", "V01", components=False)
    with h5py.File(source, "a") as file:
        del file["V01/dt"]
        file["V01/dt"] = np.array([1.0, 2.0])
    with pytest.raises(CpunetError, match="the file has none"):
        read_library(source)
    with pytest.raises(CpunetError, match="no realistic library"):
        merge_libraries([source], tmp_path / "merged.lh5")
