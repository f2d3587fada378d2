"""A matched response from files to a run folder, and from there to translated pulses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cpunet.electronics.tails_law import TailsLaw
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import Run
from cpunet.training.train import train
from cpunet.translation.translator import REN
from synthetic import (
    Files,
    after_pole_and_decay,
    in_traces,
    load_recipe,
    one_line,
    sampled,
    two_sites,
    write_pulses,
)

DT_NS, FINE = 16.0, 16
POLE_NS, DECAY_US, NOISE_KEV, KEV = 70.0, 60.0, 2.0, 2614.511
N = 420
PREPARED = 0.8 / np.exp(-400 * DT_NS * 1e-3 / DECAY_US)  # height of a prepared pulse
ONE_START = (
    "generator.poles_ns=[50]",
    "generator.slow_ns=[]",
    "generator.fast_decays_us=[]",
    "training.start_factors=[1]",
    "training.steps=14",
)
RECIPE = load_recipe("fast", ONE_START)


def charge(n: int, seed: int) -> np.ndarray:
    """Charge of two sites with logistic edges, finely sampled."""
    rng = np.random.default_rng(seed)
    time = (np.arange(225 * FINE) + 0.5) / FINE

    def site() -> np.ndarray:
        place = rng.uniform(60, 110, (n, 1))
        return 1 / (1 + np.exp(-(time - place) / rng.uniform(1.5, 3.0, (n, 1))))

    return two_sites(rng, n, site)


def digitised(n: int, seed: int, *, noise_kev: float = NOISE_KEV) -> FloatArray:
    """Traces in ADC behind a pole and a decay, by recursion, with white noise."""
    pulses = in_traces(charge(n, seed), FINE)
    fine = after_pole_and_decay(pulses, DT_NS / FINE, POLE_NS, 1e3 * DECAY_US)
    clean = sampled(fine, FINE).astype(np.float32)
    noise = np.random.default_rng(seed + 100).normal(0, noise_kev, clean.shape)
    return np.round(15_000 + 9.6 * (KEV * clean + noise)).astype(np.float32)


def written(path: Path, waveforms: FloatArray, kev: float = KEV) -> PulseFile:
    energies = np.full(len(waveforms), kev)
    write_pulses(path, Pulses.of(waveforms, dt_ns=DT_NS, energy_kev=energies))
    return PulseFile(path)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("files")
    return Files(
        written(folder / "sim.lh5", sampled(charge(N, seed=1), FINE)),
        written(folder / "data.lh5", digitised(N, seed=2)),
    )


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
    few = written(tmp_path / "few.lh5", sampled(charge(40, seed=1), FINE))
    with pytest.raises(CpunetError, match=r"^40 simulated and \d+ measured pulses; 200 of"):
        train(few, files.data, tmp_path / "run", recipe=RECIPE)
    with pytest.raises(CpunetError, match=r"neither has a pulse of 300-400 that can be used"):
        train(*files, tmp_path / "run", recipe=RECIPE, peak="FEP,300-400")
    assert [path.name for path in tmp_path.iterdir()] == ["few.lh5"]


def test_noise_needs_baselines(tmp_path: Path) -> None:
    tiny = ["training.noise=baselines", "generator.width=2", "training.iterations=1"]
    sim = written(tmp_path / "1.lh5", sampled(charge(20, seed=1), FINE))
    few = sim, written(tmp_path / "2.lh5", digitised(20, seed=2))
    recipe = load_recipe("published", tiny)
    parts = ("2.lh5: no baselines to draw noise from", "training.noise=none")
    one_line(lambda: train(*few, tmp_path / "run", recipe=recipe, device="cpu"), *parts)


@pytest.mark.thorough
def test_tails_of_earlier_pulses_are_learned_without_being_asked(
    files: Files, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "cpunet")
    traces, rng = digitised(N, seed=2), np.random.default_rng(7)
    law = TailsLaw(2.5, DECAY_US, (100, 300, 900, 2000))
    left = law.draw(N, rng)[:, np.newaxis]
    decay = np.exp(-np.arange(traces.shape[1]) * DT_NS * 1e-3 / DECAY_US)
    data = written(tmp_path / "data.lh5", np.round(traces + 9.6 * left * decay))
    made = train(files.sim, data, tmp_path / "run", recipe=RECIPE, seed=3, device="cpu")
    fit = made.fit.model_dump()
    assert fit["chi_square"] < 1.6 * fit["moments"]
    assert fit["parameters"]["pole_1_ns"] == pytest.approx(POLE_NS, rel=0.03)
    assert fit["parameters"]["decay_us"] == pytest.approx(DECAY_US, rel=0.01)
    told = fit["tails"]
    assert told["rate_khz"] == pytest.approx(2.5, abs=3.5 * told["rate_error_khz"])
    assert any(note.startswith("pile-up tails: ") for note in caplog.messages)
    ren = REN.load(tmp_path / "run")
    assert ren.tails is not None
    assert ren.tails.law.rate_khz == told["rate_khz"]
    # without tails the noise is that of empty baselines
    assert fit["noise"]["rms"] == pytest.approx(NOISE_KEV * PREPARED, rel=0.07)
