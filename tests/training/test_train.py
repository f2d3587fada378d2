"""Training: provenance, progress, devices; a matched response from files to a run folder."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import cpunet
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import load_pulses, require_same_sampling
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import Run, resolve_device
from cpunet.training.train import train
from synthetic import (
    DT_NS,
    KEV,
    SMALL_NETWORK,
    Files,
    load_recipe,
    one_line,
    write_files,
    write_line,
    write_pulses,
)

SMALLER = "discriminator.samples_per_step=16", "training.iterations=2", "training.batch_size=2"
RECIPE = load_recipe("published", [*SMALL_NETWORK, *SMALLER])
N = 30
# of `write_line`: 4000 samples, 20 of 26000 ADC
POLE_NS, DECAY_US, NOISE_KEV = 70.0, 64.0, 2.01
PREPARED = 0.8 / np.exp(-400 * DT_NS * 1e-3 / DECAY_US)  # height of a prepared pulse
ONE_POLE = "generator.poles_ns=[50]", "generator.slow_ns=[]", "generator.fast_decays_us=[]"
ONE_START = "training.start_factors=[1]", "training.steps=14"
MATCHED = load_recipe("fast", [*ONE_POLE, *ONE_START])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Simulated and measured pulses, every third on the full-energy peak."""
    return write_files(tmp_path_factory.mktemp("files"), np.resize(KEV, N))


def test_provenance_counts_and_fingerprints_and_other_sampling(files):
    selection = parse_selection("SEP,DEP", RECIPE.peaks)
    sim_set = load_pulses(files[0], "simulated", RECIPE, selection)
    told = sim_set.provenance()
    assert (told.file, told.dt_ns) == (str(files[0].path), 16)
    assert (told.read, told.used) == (N, 2 * N // 3)
    assert told.rejections == {"energy_outside_selection": N // 3}
    assert told.cuts is None
    content = sim_set.prepared.pulses.waveforms.tobytes()
    assert told.sha256 == hashlib.sha256(content).hexdigest()
    require_same_sampling(sim_set, sim_set)
    other = replace(sim_set, dt_ns=10.0, path=Path("other.lh5"))
    with pytest.raises(CpunetError) as error:
        require_same_sampling(sim_set, other)
    assert str(error.value) == (
        f"{files[0].path}: sampled every 16 ns, but other.lh5 every 10 ns; "
        "resample one of them, or give `dt_ns` if one says it wrongly"
    )


def test_devices(monkeypatch):
    assert resolve_device("cpu", RECIPE) == "cpu"
    assert resolve_device("auto", RECIPE) in ("cpu", "cuda")
    for name in ("gpu", "", "CPU", "cuda:-1"):
        with pytest.raises(CpunetError, match="does not exist; use cpu, cuda or auto"):
            resolve_device(name, RECIPE)
    assert resolve_device("cuda", load_recipe("fast")) == "cpu"  # chains are NumPy
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert resolve_device("cuda:1", RECIPE) == "cuda:1"
    with pytest.raises(CpunetError, match="'cuda:2': the last of 2 GPUs is cuda:1"):
        resolve_device("cuda:2", RECIPE)


def test_a_training_tells_what_it_does(files, tmp_path, stages, caplog):
    caplog.set_level("INFO", "cpunet")
    made = train(*files, tmp_path / "run", recipe=RECIPE, seed=7, device="cpu")
    read = {f"Preparing {side}.lh5": [N, N] for side in ("sim", "data")}
    assert stages == read | {"Training": [2, 2]}
    told = "sim.lh5: 10 of 30 pulses used (left out: 20 energy_"
    assert any(note.startswith(told) for note in caplog.messages)
    pair = Run.load(made.folder), made
    again, before = (run.model_dump(exclude={"weights"}) for run in pair)
    assert again == before
    assert (made.seed, made.device) == (7, "cpu")


def test_a_range_of_energies(files, tmp_path, caplog):
    how = {"recipe": RECIPE, "peak": "1500-2200", "device": "cpu"}
    made = train(*files, tmp_path / "run", **how)
    told = "SEP, DEP are in the range trained on, and no test of it any more"
    assert [note for note in caplog.messages if "trained on" in note] == [told]
    assert made.peak == "1500-2200"
    assert made.sim.used == 20


def of_late_pulses(folder: Path, first: int) -> PulseFile:
    """Measured traces of 16 µs, in which a third of the pulses is at half height too late."""
    n, rng = 240, np.random.default_rng(2)
    at = first + np.linspace(0, 60, n)[:, np.newaxis]
    time = np.arange(1000) - at
    pulses = np.exp(-np.maximum(time, 0) / 4000) / (1 + np.exp(-np.clip(time, -50, 50)))
    raw = 1000 + 10 * KEV[0] * pulses + rng.normal(0, 20, pulses.shape)
    whole = Pulses.of(raw, dt_ns=16.0, energy_kev=np.full(n, KEV[0]))
    file = folder / f"{first}.lh5"
    write_pulses(file, whole, table="geds/raw", waveform_units="ADC")
    return PulseFile(file)


def test_windows_end_where_traces_do(tmp_path, caplog):
    """Without its slow pulses, a set has another distribution of drift times.

    Shorter ones do not help where traces begin too late; networks have their own.
    """
    for name, first in (("fast", 150), ("fast", 500), ("paper", 560)):
        chosen, late = load_recipe(name), of_late_pulses(tmp_path, first)
        selection = parse_selection("FEP", chosen.peaks)
        same = load_pulses(late, "measured", chosen, selection, shorten=True)
        assert same.recipe is chosen
    recipe, file = load_recipe("fast"), PulseFile(tmp_path / "560.lh5")
    as_chosen = load_pulses(file, "measured", recipe, selection)
    assert as_chosen.prepared.rejections["pulse_at_edge"] == pytest.approx(80, abs=3)
    caplog.clear()
    with caplog.at_level("WARNING", "cpunet"):
        whole = load_pulses(file, "measured", recipe, selection, shorten=True)
    assert "pulse_at_edge" not in whole.prepared.rejections
    windows, training = whole.recipe.preparation, whole.recipe.training
    assert windows.after_ns == training.after_ns == 6400 - 320
    assert whole.prepared.pulses.length == 800 - 20
    assert caplog.messages == [
        "560.lh5: 32 % of the traces end before their windows would; "
        "these end 6080 ns after the alignment, not 6400 ns"
    ]


@pytest.fixture(scope="module")
def sides(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("files")
    sim = write_line(folder / "sim.lh5", 1, None, n=420)
    return Files(sim, write_line(folder / "data.lh5", 2, POLE_NS / DT_NS, n=420))


@pytest.fixture(scope="module")
def run(sides: Files, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("runs") / "run"
    return train(*sides, folder, recipe=MATCHED, seed=3, device="cpu")


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


def test_pulses_that_cannot_be_compared_leave_nothing(sides: Files, tmp_path: Path) -> None:
    few = write_line(tmp_path / "few.lh5", 1, None, n=40)
    with pytest.raises(CpunetError, match=r"^40 simulated and \d+ measured pulses; 200 of"):
        train(few, sides.data, tmp_path / "run", recipe=MATCHED)
    with pytest.raises(CpunetError, match=r"neither has a pulse of 300-400 that can be used"):
        train(*sides, tmp_path / "run", recipe=MATCHED, peak="FEP,300-400")
    assert [path.name for path in tmp_path.iterdir()] == ["few.lh5"]


def test_noise_needs_baselines(tmp_path: Path) -> None:
    tiny = ["training.noise=baselines", "generator.width=2", "training.iterations=1"]
    sim = write_line(tmp_path / "1.lh5", 1, None, n=20)
    few = sim, write_line(tmp_path / "2.lh5", 2, POLE_NS / DT_NS, n=20)
    recipe = load_recipe("published", tiny)
    parts = ("2.lh5: no baselines to draw noise from", "training.noise=none")
    one_line(lambda: train(*few, tmp_path / "run", recipe=recipe, device="cpu"), *parts)


@pytest.mark.slow
@pytest.mark.parametrize("slew", [11.0, None])
def test_a_slew_rate_is_found_where_there_is_one(tmp_path, slew) -> None:
    settings = [] if slew is None else [f"slew_kev_per_ns={slew}"]
    stand = cpunet.make_stand(
        tmp_path / "stand", events={"FEP": 1500, "1000-1580": 2500}, settings=settings, seed=41
    )
    run = cpunet.train(stand.sim, stand.data, tmp_path / "run", peak="FEP,1000-1580")
    assert run.ok
    found = run.parameters.get("slew_kev_per_ns")
    assert found == (None if slew is None else pytest.approx(slew, rel=0.1))
