"""``cpunet check``: wrong starts, each told with its cause and a remedy that works."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cpunet.pulses.loading import SideInfo
from cpunet.pulses.reading.files import PulseFile
from synthetic import after_pole

N = 240
FEP = 2614.511


class Sides:
    """Both sides of a small stand, each of which may be made wrong."""

    def __init__(self, stand: Any, folder: Path) -> None:
        self._stand, self.folder = stand, folder
        rng = np.random.default_rng(31)
        self.sim, self.kev = stand.charge(N, rng), np.full(N, FEP) + rng.normal(0, 0.5, N)
        self.records = stand.respond(stand.charge(N, rng))

    def write_sim(self, waveforms: Any = None) -> Path:
        waveforms = np.float32(self.sim if waveforms is None else waveforms)
        file = self.folder / "sim.lh5"
        return self._stand.write(file, "geds/sim", waveforms, self.kev, units="")

    def write_data(self, name: str = "data", traces: Any = None, kev: Any = None) -> Path:
        traces = self.traces if traces is None else traces
        kev = self.kev if kev is None else kev
        return self._stand.write(self.folder / f"{name}.lh5", "geds/raw", traces, kev)

    @property
    def traces(self) -> Any:
        return self._stand.digitised(self.records, self.kev, seed=21)


@pytest.fixture
def sides(stand, tmp_path) -> Sides:
    return Sides(stand, tmp_path)


@pytest.fixture
def check(command) -> Callable[..., Any]:
    def run(sim: Path, data: Path, *words: object) -> Any:
        return command("check", "--sim", sim, "--data", data, *words)

    return run


def first(outcome: Any) -> str:
    """The first line that is not fine."""
    return next(line for line in outcome.out.splitlines() if not line.startswith("ok"))


def test_sides_that_fit(sides, check):
    picture = sides.folder / "check.png"
    done = check(sides.write_sim(), sides.write_data(), "--out", picture)
    assert done.code == 0
    bad = [line for line in done.out.splitlines() if line.startswith(("look", "stop"))]
    # few pulses are told of, and nothing else
    assert all("1000 or more are better" in line for line in bad)
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = check(sides.write_sim(), sides.write_data(), "--out", picture)
    assert "exists" in again.err.splitlines()[-1]


def test_a_window_shorter_than_the_drift_is_named_with_the_setting_that_mends_it(sides, check):
    files = sides.write_sim(), sides.write_data()
    words = ["--set", "preparation.before_ns=700", "--set", "preparation.baseline_ns=500"]
    words += ["--set", "training.before_ns=600"]
    line = first(check(*files, *words))
    assert "the window is shorter than the drift" in line
    remedy = re.search(r"preparation\.before_ns=\d+", line)
    assert remedy is not None
    done = check(*files, *words, "--set", remedy[0])
    assert "shorter than the drift" not in done.out
    assert "another detector" not in done.out


def test_a_calibration_that_is_off(sides, check):
    sim, data = sides.write_sim(), sides.write_data(kev=sides.kev * 0.99)
    lines = check(sim, data, "--peak", "2500-").out.splitlines()
    told = next(line for line in lines if "-26.1" in line)
    assert "line FEP of the measured pulses at 2588.4 keV" in told
    assert "energies times 1.01010" in told
    right = sides.write_data("right", kev=sides.kev * 0.99 * 1.0101)
    assert "would put it right" not in check(sim, right).out


def test_another_detector(sides, check):
    halves = np.arange(450) / 2
    slow = np.array([np.interp(halves, np.arange(225), row) for row in sides.sim])
    done = check(sides.write_sim(waveforms=slow), sides.write_data())
    told = next(line for line in done.out.splitlines() if "drift times" in line)
    assert done.code == 1
    assert told.startswith("stop")
    assert "electronics cannot cause this: another detector" in told
    assert "calibrate" not in told


def test_a_slow_readout_is_no_other_detector(sides, check, stand):
    """It hides differences of short rises, which simulated pulses behind it do not have."""
    slow = after_pole(sides.records, tau=20, kept=100)
    traces = stand.digitised(slow, sides.kev, seed=3)
    done = check(sides.write_sim(), sides.write_data(traces=traces))
    assert done.code == 0
    assert "another detector" not in done.out


def test_pulses_sharper_than_simulated(sides, check):
    kernel = np.ones(31) / 31
    padded = np.pad(sides.sim, ((0, 0), (30, 30)), mode="edge")
    wide = np.apply_along_axis(np.convolve, 1, padded, kernel, "valid")
    done = check(sides.write_sim(waveforms=wide), sides.write_data())
    assert "electronics cannot make pulses sharper" in done.out


@pytest.mark.parametrize("n", [50, 3])
def test_too_few_pulses(sides, check, n):
    few = sides.write_data(traces=sides.traces[:n], kev=sides.kev[:n])
    done = check(sides.write_sim(), few, "--out", sides.folder / f"{n}.png")
    assert done.code == 1
    told = next(line for line in done.out.splitlines() if line.startswith("stop"))
    assert f"measured pulses of {n} can be used" in told
    assert "a file of more events, or more energies" in told


def test_tails_of_earlier_pulses(sides, check):
    traces = sides.traces.astype(float)
    late = np.exp(-np.arange(traces.shape[1]) / 3400)
    rng = np.random.default_rng(3)
    size = rng.exponential(0.3 * np.ptp(traces, axis=1)) * (rng.uniform(size=N) < 0.4)
    traces += size[:, None] * late
    done = check(sides.write_sim(), sides.write_data(traces=np.uint16(traces.round())))
    assert "pile-up tails" in done.out


def test_how_a_file_was_read_is_remembered(stand, tmp_path):
    """What was said of a file in training holds for the same file in validation."""
    read_as = {"kev_per_adc": 0.25, "table": "geds/raw"}
    trained_on = SideInfo(place=str(stand.data.resolve()), read_as=read_as)
    other = Path(shutil.copy(stand.data, tmp_path / "other.lh5"))
    for data, expected in (
        (PulseFile(stand.data), PulseFile(stand.data, "geds/raw", None, 0.25)),
        (PulseFile(stand.data, kev_per_adc=2.0), PulseFile(stand.data, None, None, 2.0)),
        (PulseFile(other), PulseFile(other)),
    ):
        assert trained_on.reading(data) == expected
