"""A search for settings sees held-out pulses of the training's energies, and nothing else."""

from __future__ import annotations

import re
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.recipes.schema import Recipe
from cpunet.training.job import TrainingJob
from cpunet.translation.translator import REN
from cpunet.validation.tune import HeldOut, own_values, tune
from synthetic import KEV, SMALL_NETWORK, Files, load_recipe, write_files

optuna = pytest.importorskip("optuna")
Choice = optuna.distributions.CategoricalDistribution
Real = optuna.distributions.FloatDistribution
FIT = {
    "training.level_ns": Real(100, 2000, log=True),
    "training.before_ns": Choice([2048.0, 2000.0]),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Simulated and measured pulses of the full-energy peak, and some of another."""
    return write_files(tmp_path_factory.mktemp("files"), np.repeat(KEV[:2], [90, 10]))


def held_out(files: Files, *settings: str, seed: int = 0) -> HeldOut:
    recipe = load_recipe("fast", settings)
    return HeldOut.of(TrainingJob.of(files, recipe, "FEP", seed=seed, device="cpu"))


def test_held_out_pulses_are_of_the_peak_and_in_no_training(files):
    parts = held_out(files)
    for side, held in ((parts.job.sim, parts.sim), (parts.job.data, parts.data)):
        fit = side.prepared.pulses
        events = {*fit.event_number.tolist()}, {*held.event_number.tolist()}
        assert not events[0] & events[1]
        assert len(held) == int(0.3 * (len(fit) + len(held)))
        assert (held.energy_kev == 2614.511).all()
    other = held_out(files, seed=1)
    assert set(other.sim.event_number) != set(parts.sim.event_number)
    few = "peaks={FEP: {energy_kev: 2103.511, half_width_kev: 5}}"
    with pytest.raises(CpunetError, match=r"sim\.lh5: 10 pulses, of which 3 would be held out"):
        held_out(files, few)


class Giving(REN):
    """Gives pulses whatever it is asked to translate."""

    tails = None

    def __init__(self, windows: np.ndarray) -> None:
        self.windows, self.recipe = windows, load_recipe("fast")

    def apply(self, *_: Any, **__: Any) -> Any:
        return self.windows


def test_the_score_is_1_for_data_beside_data_and_more_for_what_is_not(files):
    parts = held_out(files)
    alike = parts.job.data.prepared.pulses.waveforms[: len(parts.data)]
    assert 0.3 < parts.score(Giving(alike)) < 2
    assert parts.score(Giving(parts.data.waveforms)) == 0
    assert parts.score(Giving(parts.sim.waveforms)) > 10
    lost = parts.data.waveforms.copy()
    lost[:3] = np.nan
    with pytest.raises(CpunetError, match="% of the held-out pulses have no translation"):
        parts.score(Giving(lost))


@pytest.mark.parametrize(
    ("space", "words"),
    [
        ({"training.rigde": Real(0.1, 0.2)}, "space: training.rigde: there is no such"),
        ({"training": Real(0.1, 0.2)}, "space: training: there is no such"),
        ({"peaks.FEP.energy_kev": Real(1, 2)}, "space: peaks.FEP.energy_kev: only"),
        ({"training.before_ns": Real(-1, 2)}, "space: settings: training.before_ns: Input"),
        ({"training.steps": Choice([10, "many"])}, "space: settings: training.steps: Input"),
        ({}, "the search space is empty"),
    ],
)
def test_what_cannot_be_searched_is_named(space, words):
    with pytest.raises(CpunetError, match=re.escape(words)):
        own_values(load_recipe("fast"), space)


@pytest.fixture
def tried(monkeypatch) -> list[float]:
    """Trainings that cost nothing: the score is near the setting that is best."""
    tried: list[float] = []

    def score(_self: Any, recipe: Recipe) -> float:
        tried.append(recipe.training.level_ns)
        return 1 + abs(tried[-1] - 1000)

    monkeypatch.setattr(HeldOut, "train", lambda _self, recipe: recipe)
    monkeypatch.setattr(HeldOut, "score", score)
    return tried


def states(study: Any) -> list[str]:
    return [trial.state.name for trial in study.trials]


def test_a_search_goes_on_and_is_the_same_with_the_same_seed(files, tried, tmp_path):
    recipe, out = load_recipe("fast", ["training.before_ns=2000"]), tmp_path / "tune"
    study = tune(*files, out, FIT, recipe=recipe, trials=2)
    own = {"training.level_ns": recipe.training.level_ns, "training.before_ns": 2000}
    assert study.trials[0].params == own
    tune(*files, out, FIT, recipe=recipe, trials=10)
    assert len(tried) == 10
    again = tune(*files, out, FIT, recipe=recipe, trials=10)
    assert len(tried) == 10
    assert states(again) == ["COMPLETE"] * 10
    tune(*files, tmp_path / "other", FIT, recipe=recipe, trials=4)
    assert tried[10:] == tried[:4]

    best = min(again.trials, key=lambda trial: trial.value).params
    tuned = load_recipe(str(out / "best.yaml"))
    assert tuned.training.level_ns == best["training.level_ns"]
    assert tuned.training.before_ns == best["training.before_ns"]
    assert tuned.scores == recipe.scores

    with pytest.raises(CpunetError, match="begun with other settings or pulses: "):
        tune(*files, out, FIT, recipe=recipe, trials=12, seed=1)


def test_two_processes_share_a_search(files, tried, monkeypatch, tmp_path):
    recipe, out, score = load_recipe("fast"), tmp_path / "tune", HeldOut.score

    def joined(*trial: Any) -> float:
        monkeypatch.setattr(HeldOut, "score", score)
        tune(*files, out, FIT, recipe=recipe, trials=3)  # while the first trial of another runs
        return score(*trial)

    monkeypatch.setattr(HeldOut, "score", joined)
    study = tune(*files, out, FIT, recipe=recipe, trials=3)
    assert states(study) == ["COMPLETE"] * 4
    assert len(set(tried)) == 4


@pytest.mark.parametrize("error", [CpunetError("the chain is lost"), SystemExit(130)])
def test_a_failed_trial_counts_and_an_interrupted_one_does_not(
    files, tried, monkeypatch, tmp_path, error
):
    recipe, out = load_recipe("fast"), tmp_path / "tune"
    with monkeypatch.context() as patch:
        patch.setattr(HeldOut, "score", Mock(side_effect=error))
        with pytest.raises(type(error), match=r"no trial has a score; the first: the|130"):
            tune(*files, out, FIT, recipe=recipe, trials=1)
    study = tune(*files, out, FIT, recipe=recipe, trials=2)
    first = ["FAIL"] if isinstance(error, CpunetError) else ["RUNNING", "COMPLETE"]
    assert states(study) == [*first, "COMPLETE"]
    assert len(tried) == len(study.trials) - 1


@pytest.mark.thorough
def test_networks_are_searched(files, tmp_path, monkeypatch):
    forward = PositionalUNet.forward

    def near_the_input(network, pulses, **options):  # or no trial has a tail slope
        return pulses + 0.01 * forward(network, pulses, **options)

    monkeypatch.setattr(PositionalUNet, "forward", near_the_input)
    space = {"generator.width": Choice([2, 4]), "training.rate_generators": Real(1e-4, 1e-2)}
    few = ["discriminator.samples_per_step=80", "training.iterations=4", "scores.bootstraps=10"]
    recipe = load_recipe("published", [*SMALL_NETWORK, *few])
    study = tune(*files, tmp_path / "tune", space, recipe=recipe, trials=2)
    assert states(study) == ["COMPLETE"] * 2
    assert (tmp_path / "tune" / "best.yaml").is_file()
