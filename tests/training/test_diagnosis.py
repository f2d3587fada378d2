"""What a poor fit is put down to."""

from __future__ import annotations

from itertools import pairwise

from cpunet.training.diagnosis import beyond, diagnosis, parts_off

EDGES = [-100, -60, -40, -25, -15, -8, 0, 8, 15, 22, 30, 40, 52, 66, 84, 110, 140, 300]
QUIET = {f"samples {a} to {b}": 0.5 for a, b in pairwise(EDGES)}
QUIET |= {f"current amplitude, bin {i}": -0.5 for i in range(1, 9)} | {"tail slope": 0.3}


def off(size: float, *starts: str) -> dict[str, float]:
    return {name: size if name.startswith(starts) else pull for name, pull in QUIET.items()}


def test_nothing_is_off_by_chance():
    assert parts_off(QUIET) == {}
    assert diagnosis(QUIET) == []


def test_each_part_is_named():
    assert list(parts_off(off(12, "tail", "samples 110", "samples 140"))) == ["tail"]
    assert list(parts_off(off(-9, "current"))) == ["amplitude"]
    assert list(parts_off(off(20, "samples 22", "samples 30"))) == ["top"]
    (line,) = diagnosis(off(-30, "samples -60", "samples -40"))
    assert line.startswith("the onset is off by 19 σ: no readout shapes it")
    assert "cpunet calibrate" in line


def test_physics_come_first_though_more_is_off_elsewhere():
    pulls = dict(QUIET)
    pulls |= {name: 40.0 for name in pulls if name.startswith("current")}
    pulls |= {name: 15.0 for name in pulls if name.startswith("samples -")}
    assert list(parts_off(pulls)) == ["onset", "amplitude"]


def test_bands_are_taken_together():
    pulls = {f"{band}: {name}": 9.0 for band in ("FEP", "1000-1580 keV") for name in QUIET}
    assert set(parts_off(pulls)) == {"onset", "edge", "top", "tail", "amplitude"}


def test_shares_that_no_readout_has():
    assert beyond({"slow_100_ns": 0.04, "slow_400_ns": -0.06, "pole_1_ns": 40}) == []
    assert "79 % of the charge would arrive too early" in beyond({"slow_100_ns": -0.79})[0]
    assert "60 % of the charge would arrive late" in beyond({"slow_100_ns": 0.6})[0]
