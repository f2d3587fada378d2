"""A matched response from files to a run folder, and from there to translated pulses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.training.run import Run
from cpunet.training.train import train
from synthetic import Files, load_recipe, one_line, write_line

DT_NS, N = 16.0, 420
# of `write_line`: 4000 samples, 20 of 26000 ADC
POLE_NS, DECAY_US, NOISE_KEV = 70.0, 64.0, 2.01
PREPARED = 0.8 / np.exp(-400 * DT_NS * 1e-3 / DECAY_US)  # height of a prepared pulse
ONE_POLE = "generator.poles_ns=[50]", "generator.slow_ns=[]", "generator.fast_decays_us=[]"
ONE_START = "training.start_factors=[1]", "training.steps=14"
RECIPE = load_recipe("fast", [*ONE_POLE, *ONE_START])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("files")
    sim = write_line(folder / "sim.lh5", 1, None, n=N)
    return Files(sim, write_line(folder / "data.lh5", 2, POLE_NS / DT_NS, n=N))


@pytest.fixture(scope="module")
def run(files: Files, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("runs") / "run"
    return train(*files, folder, recipe=RECIPE, seed=3, device="cpu")


def test_a_run_tells_of_its_fit(run: Run) -> None:
    fit = json.loads((run.folder / "run.json").read_text())["fit"]
    assert Run.load(run.folder).fit.model_dump(exclude_unset=True) == fit
    assert fit["chi_square"] < 1.6 * fit["moments"]
    assert max(map(abs, fit["pulls"].values())) < 5
    assert fit["in_no_band"] == {"sim": 0, "data": 0}
    assert fit["parameters"]["pole_1_ns"] == pytest.approx(POLE_NS, rel=0.03)
    assert fit["parameters"]["decay_us"] == pytest.approx(DECAY_US, rel=0.01)
    assert fit["noise"]["rms"] == pytest.approx(NOISE_KEV * PREPARED, rel=0.07)
    assert fit["tails"]["rate_khz"] == 0
    records = [json.loads(x) for x in (run.folder / "losses.jsonl").read_text().splitlines()]
    assert [record["iteration"] for record in records] == list(range(1, fit["steps"] + 1))
    assert records[-1]["losses"]["chi_square"] == pytest.approx(fit["chi_square"])


def test_pulses_that_cannot_be_compared_leave_nothing(files: Files, tmp_path: Path) -> None:
    few = write_line(tmp_path / "few.lh5", 1, None, n=40)
    with pytest.raises(CpunetError, match=r"^40 simulated and \d+ measured pulses; 200 of"):
        train(few, files.data, tmp_path / "run", recipe=RECIPE)
    with pytest.raises(CpunetError, match=r"neither has a pulse of 300-400 that can be used"):
        train(*files, tmp_path / "run", recipe=RECIPE, peak="FEP,300-400")
    assert [path.name for path in tmp_path.iterdir()] == ["few.lh5"]


def test_noise_needs_baselines(tmp_path: Path) -> None:
    tiny = ["training.noise=baselines", "generator.width=2", "training.iterations=1"]
    sim = write_line(tmp_path / "1.lh5", 1, None, n=20)
    few = sim, write_line(tmp_path / "2.lh5", 2, POLE_NS / DT_NS, n=20)
    recipe = load_recipe("published", tiny)
    parts = ("2.lh5: no baselines to draw noise from", "training.noise=none")
    one_line(lambda: train(*few, tmp_path / "run", recipe=recipe, device="cpu"), *parts)
