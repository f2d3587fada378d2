"""Trainings of many seeds: each is what a single training gives, and none stops the others."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from torch import nn

from cpunet.analysis.paired import align_half_maximum
from cpunet.analysis.seed_scores import failed_seeds, seed_table
from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import InputFile
from cpunet.jobs.studies.ensemble import train_ensemble
from cpunet.jobs.training.train import train_run
from cpunet.jobs.training.training_job import TrainOptions
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import FloatArray
from cpunet.recipes import load_recipe
from cpunet.training.ensemble_folder import read_study
from cpunet.training.run_folder import write_run
from cpunet.translation.backends import Backend
from cpunet.translation.ensemble import EnsembleREN
from cpunet.translation.translator import REN
from synthetic import KEV, SMALL_NETWORK, WITHOUT_CHAIN, Files, edges, write_files

RECIPE = load_recipe(
    "small",
    [
        *SMALL_NETWORK,
        *WITHOUT_CHAIN,
        "discriminator.samples_per_step=80",
        "training.iterations=3",
        "scores.bootstraps=10",
    ],
)
N = 60


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """Simulated and measured pulses, every third on the full-energy peak."""
    return write_files(tmp_path_factory.mktemp("files"), np.resize(KEV, N))


class Made(NamedTuple):
    folder: Path
    told: dict[str, Any]


@pytest.fixture(scope="module")
def made(
    files: Files, tmp_path_factory: pytest.TempPathFactory, pool_of_none: Callable[..., None]
) -> Made:
    """Two seeds trained and scored in this process; do not change it."""
    folder = tmp_path_factory.mktemp("made") / "ens"
    how = {"seeds": 2, "jobs": 1, "threads": 1, "device": "cpu"}
    with pytest.MonkeyPatch.context() as patch:
        pool_of_none(patch)
        train_ensemble(*files, folder, RECIPE, validate=False, **how)
        told = train_ensemble(*files, folder, RECIPE, resume=True, **how)
    return Made(folder, told)


@pytest.mark.slow
def test_processes_score_their_seeds(files, made, tmp_path):
    out = tmp_path / "ens"
    told = train_ensemble(*files, out, RECIPE, seeds=2, jobs=2, threads=1, device="cpu")
    for seed in (0, 1):
        assert weights(out / f"seed_00{seed}") == weights(made.folder / f"seed_00{seed}")
        assert told["seeds"][str(seed)]["iou"] == made.told["seeds"][str(seed)]["iou"]
    assert told["table"] == made.told["table"]


def weights(run: Path) -> bytes:
    return (run / "weights.safetensors").read_bytes()


@pytest.mark.thorough
def test_a_seed_is_what_a_single_training_gives(files, made, tmp_path):
    train_run(*files, tmp_path / "1", RECIPE, TrainOptions(seed=1, device="cpu"))
    assert weights(made.folder / "seed_001") == weights(tmp_path / "1")
    assert weights(made.folder / "seed_000") != weights(tmp_path / "1")


def test_the_ensemble_tells_of_its_seeds(made):
    told = json.loads((made.folder / "ensemble.json").read_text())
    assert told["begun_with"]["recipe"]["name"] == "small"
    assert told["begun_with"]["data"]["used"] <= N // 3
    assert list(told["seeds"]) == ["0", "1"]
    assert told["failures"] == {}
    for seed, entry in told["seeds"].items():
        run = made.folder / f"seed_00{seed}"
        assert entry["state"] == "trained"
        assert entry["seconds"] == json.loads((run / "run.json").read_text())["seconds"]
        metrics = json.loads((run / "metrics.json").read_text())
        assert "rc" not in metrics["peaks"]["SEP"]["parameters"]["drift_time"]["iou"]
        for name, score in entry["iou"]["SEP"].items():
            assert score == metrics["peaks"]["SEP"]["parameters"][name]["iou"]["ren"]
    assert (made.folder / "seeds.png").read_bytes()[:4] == b"\x89PNG"
    row = next(r for r in told["table"] if (r["peak"], r["score"]) == ("SEP", "drift_time"))
    scores = [told["seeds"][seed]["iou"]["SEP"]["drift_time"] for seed in "01"]
    assert row["median"] == pytest.approx(np.mean(scores))
    assert row["worst"] == pytest.approx(np.quantile(scores, 0.05))


@pytest.mark.thorough
def test_going_on_keeps_what_is_finished_and_records_what_fails(files, made, tmp_path, no_pool):
    folder = Path(shutil.copytree(made.folder, tmp_path / "ens"))
    before = (folder / "seed_000" / "run.json").stat().st_mtime_ns
    shutil.rmtree(folder / "seed_001")
    (folder / "seed_002").write_text("in the way")
    told = train_ensemble(
        *files, folder, RECIPE, seeds=3, jobs=1, threads=1, device="cpu", resume=True
    )
    assert (folder / "seed_000" / "run.json").stat().st_mtime_ns == before
    assert weights(folder / "seed_001") == weights(made.folder / "seed_001")
    assert [entry["state"] for entry in told["seeds"].values()] == [
        "trained",
        "trained",
        "failed",
    ]
    assert list(told["failures"]) == [2]
    assert "seed_002: exists already" in told["failures"][2]
    assert told["failure_rate"] == pytest.approx(len({2, *told["poor"]}) / 3)
    training = RECIPE.training.model_copy(update={"batch_size": 5})
    other = RECIPE.model_copy(update={"training": training})
    with pytest.raises(CpunetError, match=r"another recipe: training\.batch_size 4 → 5"):
        train_ensemble(*files, folder, other, device="cpu", resume=True)


@pytest.mark.parametrize("record", [None, {"state": "failed", "reason": "no truth"}])
def test_a_finished_seed_is_counted_whatever_was_recorded(
    files, made, tmp_path, no_pool, record
):
    """The program was stopped after the seed and before its record, or its score had failed."""
    folder = Path(shutil.copytree(made.folder, tmp_path / "ens"))
    told = json.loads((folder / "ensemble.json").read_text())
    told["seeds"] = {} if record is None else {"0": record, "1": record}
    (folder / "ensemble.json").write_text(json.dumps(told))
    if record is not None:
        (folder / "seed_001" / "metrics.json").unlink()
    again = train_ensemble(
        *files, folder, RECIPE, seeds=2, device="cpu", resume=True, validate=record is None
    )
    assert [entry["state"] for entry in again["seeds"].values()] == ["trained", "trained"]
    assert again["seeds"]["0"]["iou"] == made.told["seeds"]["0"]["iou"]
    assert again["seeds"]["1"]["seconds"] == made.told["seeds"]["1"]["seconds"]
    assert again["failure_rate"] == len(again["poor"]) / 2


def test_no_folder_is_overwritten_by_mistake(files, made, tmp_path):
    with pytest.raises(CpunetError, match="exists already; continue with --resume"):
        train_ensemble(*files, made.folder, RECIPE, device="cpu")
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("")
    for how in ({"force": True}, {"resume": True}):
        with pytest.raises(CpunetError, match=r"no folder that cpunet ensemble made"):
            train_ensemble(*files, mine, RECIPE, device="cpu", **how)
    bad = InputFile(files.sim.path, table="none")
    with pytest.raises(CpunetError, match="none"):
        train_ensemble(bad, files.data, tmp_path / "new", RECIPE, device="cpu")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def scored(iou: float | None, auc: float = 0.5) -> dict[str, Any]:
    parameter = {"iou": {"ren": iou, "ceiling": 85.0}}
    peak = {"parameters": {"drift_time": parameter}, "two_sample": {"ren": {"auc": auc}}}
    return {"peaks": {"SEP": peak}}


def test_a_score_below_nine_tenths_of_the_median_or_missing_is_a_failure():
    seeds = {n: scored(80.0 + n) for n in range(9)} | {9: scored(None), 10: scored(75.0)}
    seeds |= {11: scored(75.6, auc=0.9), 12: scored(75.7)}
    # of 12 scores the median is (82 + 83) / 2 … of 75, 75.6, 75.7, 80, … 88: 82.5; 0.9: 74.25
    assert failed_seeds(seeds) == {9: ["SEP drift_time"]}
    seeds[10] = scored(74.2)
    assert failed_seeds(seeds) == {9: ["SEP drift_time"], 10: ["SEP drift_time"]}
    iou, auc = seed_table(seeds)
    assert (iou["median"], iou["failures"], iou["ceiling"]) == (82.5, 2, 85.0)
    assert (auc["score"], auc["median"], auc["failures"]) == ("auc", 0.5, None)
    assert auc["worst"] > 0.5


def response(folder: Path, pole: float, *overrides: str) -> Path:
    recipe = load_recipe("fast", [f"generator.poles_ns=[{pole}, 30]", *overrides])
    folder.mkdir(parents=True)
    info = {"peak": "FEP", "seed": 1, "seconds": 1.0, "device": "cpu", "dt_ns": 16.0}
    model = nn.ModuleDict({"ren": ResponseGenerator(recipe.generator, 16.0)})
    write_run(folder, model, recipe, info | {"recipe": "fast"})
    return folder


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of responses with three poles."""
    folder = tmp_path_factory.mktemp("several")
    for seed, pole in enumerate((45, 50, 58)):
        response(folder / f"seed_{seed:03d}", pole)
    (folder / "seed_003.unfinished").mkdir()
    return folder


@pytest.fixture(scope="module")
def windows() -> FloatArray:
    """Prepared simulated pulses."""
    pulses = np.ones((40, 800), np.float32)
    pulses[:, :325] = 0
    pulses[:, 325:550] = edges(40, 5, (1.5, 4))
    return pulses


def test_mean_and_spread_are_those_of_pulses_aligned_at_half_maximum(several, windows):
    ensemble = EnsembleREN.load(several)
    mean, spread = ensemble.mean_and_spread(windows)
    assert mean.shape == spread.shape == windows.shape
    each = [
        align_half_maximum(ren.apply(windows, noise=False), 100, 200)
        for ren in ensemble.members
    ]
    np.testing.assert_allclose(
        align_half_maximum(mean, 100, 200), np.mean(each, axis=0), atol=2e-4
    )
    assert np.abs(spread.max(axis=1) - np.std(each, axis=0, ddof=1).max(axis=1)).max() < 2e-4
    assert spread.max() > 1e-3


class Later(Backend):
    """Another backend's pulses, one sample later."""

    def __init__(self, backend: Backend) -> None:
        self.network, self.backend = backend.network, backend

    def __call__(self, *words: Any) -> Any:
        result, codes = self.backend(*words)
        return np.pad(result, ((0, 0), (1, 0)), mode="edge")[:, :-1], codes


def test_a_member_that_is_one_sample_late_adds_no_spread(several, windows):
    ren = REN.load(several / "seed_000")
    late = REN(Later(ren.backend), ren.recipe, ren.dt_ns)
    mean, spread = EnsembleREN([ren, late]).mean_and_spread(windows)
    plain = np.std([r.apply(windows, noise=False) for r in (ren, late)], axis=0, ddof=1)
    # but for what the spline of a cut-off end does
    assert spread[:, 5:-5].max() < 1e-2 * plain.max()
    aligned = align_half_maximum(ren.apply(windows, noise=False), 100, 200)
    np.testing.assert_allclose(align_half_maximum(mean, 100, 200), aligned, atol=1e-4)


def test_pulses_without_a_translation_are_rows_of_nan(several, windows):
    broken = windows.copy()
    broken[3] = np.nan
    mean, spread = EnsembleREN.load(several).mean_and_spread(broken)
    for found in (mean, spread):
        assert np.flatnonzero(np.isnan(found).any(axis=1)).tolist() == [3]
        assert np.isnan(found[3]).all()


def test_a_translated_set_is_drawn_from_all_members(several, windows):
    ensemble = EnsembleREN.load(several)
    raw = np.repeat(edges(40, 5, (1.5, 4)), 10, axis=0)
    done = ensemble.translate(raw, noise=False, seed=2)
    by_member = np.stack([ren.translate(raw, noise=False) for ren in ensemble.members])
    like = np.abs(by_member - done).max(axis=2) < 1e-6
    assert (like.sum(axis=0) == 1).all()
    shares = like.mean(axis=1)
    assert shares.sum() == pytest.approx(1)
    assert (np.abs(shares - 1 / 3) < 5 * np.sqrt(2 / 9 / 400)).all()
    np.testing.assert_array_equal(done, ensemble.translate(raw, noise=False, seed=2))
    assert (done != ensemble.translate(raw, noise=False, seed=3)).any()


def test_what_is_no_ensemble_is_told_in_a_line(several, tmp_path):
    with pytest.raises(CpunetError, match="no folder of an ensemble with a finished seed"):
        EnsembleREN.load(tmp_path)
    first = REN.load(response(tmp_path / "seed_000", 45))
    with pytest.raises(CpunetError, match="one finished seed only"):
        EnsembleREN.load(tmp_path)
    other = REN.load(response(tmp_path / "seed_001", 45, "preparation.samples_after=410"))
    with pytest.raises(CpunetError, match=r"member 1 .* another preparation"):
        EnsembleREN([first, other])


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({"seeds": {}}, "begun_with: Field required"),
        ({"begun_with": 3}, "begun_with: Input should be a valid dict"),
        ({"begun_with": {}, "seeds": [1]}, "seeds: Input should be a valid dict"),
        ({"begun_with": {}, "seeds": {"x": {"state": "trained"}}}, "String should match"),
        ({"begun_with": {}, "seeds": {"0": {}}}, "seeds.0.state: Field required"),
        ({"begun_with": {"peak": []}}, "resumed with another peak"),
        ([], "no mapping"),
    ],
)
def test_a_damaged_record_is_one_line(tmp_path, content, told):
    path = tmp_path / "ensemble.json"
    assert read_study(path, {"peak": "FEP"}) is None
    path.write_text(json.dumps(content))
    with pytest.raises(CpunetError, match=told):
        read_study(path, {"peak": "FEP"})
