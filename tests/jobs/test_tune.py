"""A search for settings sees held-out pulses of the training's energies, and nothing else."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cpunet.cli.main import main
from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import load_measured, load_simulated
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.studies.fingerprints import fingerprints
from cpunet.jobs.studies.trial_score import HeldOut
from cpunet.jobs.studies.tune import tune_recipe
from cpunet.jobs.studies.tuning_study import (
    _is_gone,
    counted,
    found,
    lose,
    open_study,
    queue_first,
    suggested,
    this_worker,
)
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.training.loop import train
from cpunet.training.search_space import search_space, value_of, with_values
from cpunet.translation.translator import REN
from synthetic import KEV, SMALL_NETWORK, WITHOUT_CHAIN, Files, write_files

SPACE = (
    "search={generator.width: {choices: [2, 4]}, "
    "training.rate_generators: {low: 1.0e-4, high: 1.0e-2, log: true}}"
)
TINY = [
    *SMALL_NETWORK,
    *WITHOUT_CHAIN,
    "discriminator.samples_per_step=80",
    "training.iterations=8",
    "training.checkpoint_interval=2",
    "scores.bootstraps=10",
    SPACE,
]
N = 100


def tiny(*more: str) -> Recipe:
    return load_recipe("small", [*TINY, *more])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Simulated and measured pulses of the full-energy peak, and some of another."""
    return write_files(tmp_path_factory.mktemp("files"), np.repeat(KEV[:2], [90, 10]))


def held_out(files: Files, recipe: Recipe, seed: int = 0) -> HeldOut:
    selection = parse_selection("FEP", recipe.peaks)
    sim = load_simulated(files.sim, recipe, selection, Monitor())
    data = load_measured(files.data, recipe, selection, Monitor())
    return HeldOut.of(sim, data, files.data, recipe, seed)


def test_held_out_pulses_are_of_the_peak_and_in_no_training(files):
    parts = held_out(files, tiny())
    for fit, held in ((parts.fit.sim, parts.sim), (parts.fit.data, parts.data)):
        events = {*fit.event_number.tolist()}, {*held.event_number.tolist()}
        assert not events[0] & events[1]
        assert len(held) == int(0.3 * (len(fit) + len(held)))
        assert (held.energy_kev == 2614.511).all()
    other = held_out(files, tiny(), seed=1)
    assert set(other.sim.event_number) != set(parts.sim.event_number)
    few = tiny("peaks={FEP: {energy_kev: 2103.511, half_width_kev: 5}}")
    with pytest.raises(CpunetError, match=r"sim\.lh5: 10 pulses, of which 3 would be held out"):
        held_out(files, few)


class Giving(REN):
    """Gives pulses whatever it is asked to translate."""

    remains = None

    def __init__(self, windows: np.ndarray, recipe: Recipe) -> None:
        self.windows, self.recipe = windows, recipe

    def seeded(self, seed: int | None) -> torch.Generator:
        return torch.Generator()

    def apply(self, *_: Any, **__: Any) -> Any:
        return self.windows


def test_the_score_is_1_for_data_beside_data_and_more_for_what_is_not(files):
    recipe = tiny("scores.bootstraps=100")
    parts = held_out(files, recipe)
    alike = parts.score(Giving(parts.fit.data.waveforms[: len(parts.data)], recipe))
    assert 0.3 < alike < 2
    assert parts.score(Giving(parts.data.waveforms, recipe)) == 0
    assert parts.score(Giving(parts.sim.waveforms, recipe)) > 10
    lost = parts.data.waveforms.copy()
    lost[:3] = np.nan
    with pytest.raises(CpunetError, match="% of the held-out pulses have no translation"):
        parts.score(Giving(lost, recipe))


def test_energies_that_one_side_lacks_end_a_study_before_its_trials(files, tmp_path):
    measured = write_files(tmp_path, np.repeat(KEV[:1], 90)).data
    with pytest.raises(CpunetError, match=r"data\.lh5: no pulse of SEP can be used"):
        fingerprints(files.sim, measured, tiny(), "FEP,SEP", Monitor())


@pytest.mark.slow
def test_scores_on_the_way_do_not_change_the_training(files):
    recipe = tiny("training.iterations=6")
    parts, told = held_out(files, recipe), []
    ren = parts.train(recipe, 3, "cpu", lambda *at: told.append(at))
    plain = train(parts.fit.sim.waveforms, parts.fit.data.waveforms, recipe, seed=3)
    for name, weights in plain.ren.state_dict().items():
        torch.testing.assert_close(ren.backend.network.state_dict()[name], weights)
    assert [iteration for iteration, _ in told] == [2, 4]
    assert np.isfinite([score for _, score in told]).all()

    def enough(_iteration: int, _score: float) -> None:
        raise KeyError

    with pytest.raises(KeyError):
        parts.train(recipe, 3, "cpu", enough)


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ("{training.rigde: {low: 0.1, high: 0.2}}", "search.training.rigde: there is no such"),
        ("{training: {low: 0.1, high: 0.2}}", "training"),
        ("{peaks.FEP.energy_kev: {low: 1, high: 2}}", "search.peaks.FEP.energy_kev: only"),
        ("{training.ridge: {low: 0.1, high: 2}}", "training.ridge = 2: training.ridge: "),
        ("{training.clip: {low: -1, high: 2}}", "training.clip = -1: training.clip: "),
        ("{training.steps: {choices: [10, many]}}", "training.steps = many: training.steps"),
        ("{training.ridge: {low: 0.1}}", "search.training.ridge: "),
        ("{training.ridge: {low: 0.2, high: 0.1}}", "search.training.ridge: "),
        ("{training.ridge: {low: 0, high: 0.1, log: true}}", "search.training.ridge: "),
        ("{training.ridge: {choices: [0.1]}}", "search.training.ridge"),
        ("{training.ridge: {from: 0.1, to: 1}}", "search.training.ridge"),
        ("null", "has no search space; add one"),
    ],
)
def test_what_cannot_be_searched_is_told_by_its_key(space, words):
    with pytest.raises(CpunetError) as told:
        search_space(load_recipe("fast", [f"search={space}"]))
    assert words in str(told.value)
    assert "\n" not in str(told.value)


def test_whole_numbers_can_be_choices_of_a_real_setting(tmp_path):
    space = "search={training.clip: {choices: [7, 4]}, training.ridge: {low: 0.01, high: 0.2}}"
    recipe = load_recipe("fast", [space, "training.clip=4"])
    study = open_study(tmp_path, recipe)
    queue_first(study, recipe, search_space(recipe))
    trial = study.ask()
    for key, config in search_space(recipe).items():
        assert suggested(trial, key, recipe, config) == value_of(recipe, key)
    study.tell(trial, 1.5)
    told = found(study, recipe, search_space(recipe))
    assert told["first"] == 1.5
    assert told["importances"] == {}  # one trial says nothing of them


def test_a_trial_that_was_lost_before_its_first_value_is_queued_again(tmp_path):
    recipe = tiny()
    study = open_study(tmp_path, recipe)
    queue_first(study, recipe, search_space(recipe))
    lose(study, study.ask())
    again = study.ask()
    for key, config in search_space(recipe).items():
        assert suggested(again, key, recipe, config) == value_of(recipe, key)
    assert len(counted(study)) == 1


@pytest.mark.parametrize("name", ["fast", "small", "paper"])
def test_the_recipes_own_spaces_can_be_searched(name):
    recipe = load_recipe(name)
    space = search_space(recipe)
    for key, config in space.items():
        for value in config.choices or (config.low, config.high):
            changed = with_values(recipe, {key: value})
            assert changed.search is None
            assert value_of(changed, key) == value


def test_without_optuna_there_is_a_line(files, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(CpunetError, match=r"pip install 'cpunet-hpge\[tune\]'"):
        tune_recipe(*files, tmp_path / "tune", tiny())
    assert not [*tmp_path.iterdir()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_a_process_is_gone_before_anyone_asks_how_it_ended():
    ended = subprocess.Popen(["true"])
    os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)
    host = this_worker().rpartition(":")[0]
    assert _is_gone(f"{host}:{ended.pid}")
    ended.wait()
    assert _is_gone(f"{host}:{ended.pid}")
    assert not _is_gone(this_worker())
    assert not _is_gone(f"another host:{ended.pid}")


@pytest.mark.parametrize(
    "damage",
    [
        lambda lines: [*lines, b'{"op_code": 4, "wor', *lines[-1:]],  # by a full disk
        lambda lines: [lines[0].replace(b"cpunet", b"\xff")],
        lambda lines: [lines[0], b"[]\n"],
        lambda lines: [lines[0], b'{"op_code": 99}\n'],
    ],
)
def test_a_damaged_journal_is_one_line(tmp_path, damage):
    optuna = pytest.importorskip("optuna")
    study = open_study(tmp_path, tiny())
    trial = study.ask({"x": optuna.distributions.FloatDistribution(0, 1)})
    study.tell(trial, 1.0)
    journal = tmp_path / "journal.log"
    journal.write_bytes(b"".join(damage(journal.read_bytes().splitlines(keepends=True))))
    with pytest.raises(CpunetError, match=r"journal.log: is damaged .* begin again with --fo"):
        open_study(tmp_path, tiny())


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_a_search_that_was_killed_goes_on(files, held, tmp_path, monkeypatch, capsys, no_pool):
    pytest.importorskip("optuna")
    folder = tmp_path / "tune"
    short = [*TINY, "training.iterations=4"]
    values = [word for value in short for word in ("--set", value)]
    inputs = ["--sim", files.sim.path, "--data", files.data.path, "--out", folder]
    words = ["tune", *inputs, "--recipe", "small", *values, "--trials", 2, "--jobs", 1]
    words = [*map(str, words), "--threads", "1"]
    given = {"words": words, "errors": str(tmp_path / "errors")}
    job, journal = held.forked(held.__file__, {"GIVEN": given}), folder / "journal.log"
    try:
        while not (journal.exists() and '"worker"' in journal.read_text()):
            assert job.is_alive(), "no trial was begun"
            time.sleep(0.02)
        started = held.children(job.pid)
    finally:
        job.kill()
        job.join()
    held.wait_until_gone(started)
    monkeypatch.setattr(sys, "argv", ["cpunet", *words, "--resume"])
    with pytest.raises(SystemExit) as stop:
        main()
    told = capsys.readouterr()
    assert stop.value.code == 0, told.err
    rows = [*csv.DictReader((folder / "trials.csv").read_text().splitlines())]
    assert [row["state"] for row in rows] == ["complete", "complete"]
    best = min(rows, key=lambda row: float(row["score"]))
    tuned = load_recipe(str(folder / "best.yaml"))
    assert tuned.search is None
    assert tuned.generator.width == int(best["generator.width"])
    assert tuned.training.rate_generators == float(best["training.rate_generators"])
    assert tuned.scores == tiny().scores
    # the recipe as it is was the one that was cut off
    own = {(row["generator.width"], row["training.rate_generators"]) for row in rows}
    assert ("2", str(tiny().cyclegan.training.rate_generators)) in own
    assert f"best: trial {best['number']}" in told.out
    assert "the recipe as it is has" in told.out
