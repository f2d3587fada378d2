"""Trainings that start from another: of the same kind, and from its weights."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from cpunet.errors import CpunetError
from cpunet.networks.generators import ResponseGenerator
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import Run
from cpunet.training.train import train
from cpunet.translation.translator import REN
from synthetic import (
    SMALL_NETWORK,
    load_recipe,
    one_line,
    write_line,
    write_run,
)

SHORT = (
    "training.start_factors=[1]",
    "generator.slow_ns=[]",
    "generator.fast_decays_us=[]",
)
FAST = load_recipe("fast", SHORT)
TINY = load_recipe(
    "published",
    [
        *SMALL_NETWORK,
        "discriminator.embedding_rows=20",
        "discriminator.samples_per_step=16",
        "training.iterations=1",
        "training.rate_generators=1e-12",
        "training.weight_decay=0",
    ],
)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, PulseFile]:
    folder = tmp_path_factory.mktemp("init")
    return {
        "sim": write_line(folder / "sim.lh5", 1, None),
        "one": write_line(folder / "one.lh5", 2, 4.0),
        "other": write_line(folder / "other.lh5", 3, 6.0),
    }


@pytest.fixture(scope="module")
def chain(files, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("chain") / "run"
    train(files["sim"], files["one"], out, recipe=FAST, device="cpu")
    return out


@pytest.fixture(scope="module")
def network(files, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("network") / "run"
    train(files["sim"], files["one"], out, recipe=TINY, device="cpu")
    return out


def poles(run: Path) -> list[float]:
    fit = json.loads((run / "run.json").read_text())["fit"]
    return [v for name, v in fit["parameters"].items() if name.startswith("pole")]


def test_a_run_tells_of_its_fit(chain) -> None:
    fit = json.loads((chain / "run.json").read_text())["fit"]
    assert Run.load(chain).fit.model_dump(exclude_unset=True) == fit
    assert fit["chi_square"] < 1.6 * fit["moments"]
    assert max(map(abs, fit["pulls"].values())) < 5
    assert fit["in_no_band"] == {"sim": 0, "data": 0}
    assert np.hypot(*poles(chain)) == pytest.approx(4 * 16, rel=0.05)
    assert fit["parameters"]["decay_us"] == pytest.approx(64, rel=0.02)
    # prepared pulses are 0.8 where a step has come down for 400 samples
    noise = 0.8 * np.exp(0.1) * 2614.5 * 20 / 26000
    assert fit["noise"]["rms"] == pytest.approx(noise, rel=0.1)
    assert fit["tails"]["rate_khz"] == 0
    records = [json.loads(x) for x in (chain / "losses.jsonl").read_text().splitlines()]
    assert [record["iteration"] for record in records] == list(range(1, fit["steps"] + 1))
    assert records[-1]["losses"]["chi_square"] == pytest.approx(fit["chi_square"])


def test_pulses_that_cannot_be_compared_leave_nothing(files, tmp_path) -> None:
    few = write_line(tmp_path / "few.lh5", 1, None, n=40)
    with pytest.raises(CpunetError, match=r"^40 simulated and \d+ measured pulses; 200 of"):
        train(few, files["one"], tmp_path / "run", recipe=FAST)
    with pytest.raises(CpunetError, match=r"neither has a pulse of 300-400 that can be used"):
        train(files["sim"], files["one"], tmp_path / "run", recipe=FAST, peak="FEP,300-400")
    assert [path.name for path in tmp_path.iterdir()] == ["few.lh5"]


@pytest.mark.thorough
def test_a_stretched_drift_goes_on_only_where_a_recipe_stretches(
    files, chain, tmp_path
) -> None:
    recipe = load_recipe("fast", [*SHORT, "generator.drift_terms=1"])
    generator = ResponseGenerator(recipe.matching.generator, 16.0)
    known = REN.load(chain).backend.chain
    generator.set_noise(known.noise)
    generator.response.fill(generator.response.arrays() | known.response.arrays())
    generator.response.drift.stretch.fill(0.01)
    (tmp_path / "near").mkdir()
    write_run(
        tmp_path / "near",
        {"ren": generator},
        recipe,
        json.loads((chain / "run.json").read_text()),
    )
    start = {"init": tmp_path / "near", "device": "cpu"}
    fixed = load_recipe("fast", [*SHORT, "training.drift_terms=0"])
    alone = train(files["sim"], files["one"], tmp_path / "alone", recipe=fixed, **start)
    assert "drift_stretch" not in alone.fit.parameters
    goes_on = train(files["sim"], files["one"], tmp_path / "free", recipe=FAST, **start)
    assert abs(goes_on.fit.parameters["drift_stretch"]) < 0.05
    assert REN.load(tmp_path / "free").backend.chain.response.drift is not None


@pytest.mark.thorough
def test_networks_begin_with_the_weights_given(files, network, tmp_path) -> None:
    # a training whose rates are next to nothing stays where it began
    train(files["sim"], files["other"], tmp_path / "run", recipe=TINY, init=network, seed=5)
    before, after = (load_file(r / "weights.safetensors") for r in (network, tmp_path / "run"))
    kept = [n for n in before if n.startswith(("ren.", "iren.")) and "running" not in n]
    assert kept
    for name in kept:
        assert np.allclose(before[name], after[name], atol=1e-6), name


@pytest.mark.thorough
def test_runs_of_another_kind_are_refused(files, chain, network, tmp_path) -> None:
    with pytest.raises(CpunetError, match="from which fast cannot start"):
        train(files["sim"], files["one"], tmp_path / "a", recipe=FAST, init=network)
    with pytest.raises(CpunetError, match="from which no network can start"):
        train(files["sim"], files["one"], tmp_path / "a", recipe=TINY, init=chain)
    wider = load_recipe("published", ["generator.width=4"])
    with pytest.raises(CpunetError, match="weights of another network"):
        train(files["sim"], files["one"], tmp_path / "b", recipe=wider, init=network)
    shorter = load_recipe(
        "published",
        ["generator.width=2", "preparation.after_ns=6144", "training.losses.tail_ns=5344"],
    )
    with pytest.raises(CpunetError, match=r"windows of 400 \+ 400 .* has 400 \+ 384"):
        train(files["sim"], files["one"], tmp_path / "b", recipe=shorter, init=network)
    with pytest.raises(CpunetError, match="no finished run"):
        train(files["sim"], files["one"], tmp_path / "c", recipe=TINY, init=tmp_path / "none")
    fast_sampled = [
        write_line(tmp_path / f"{k}.lh5", k, p, 10.0) for k, p in ((1, None), (2, 4.0))
    ]
    with pytest.raises(CpunetError, match="trained on 16 ns, these pulses have 10 ns"):
        train(*fast_sampled, tmp_path / "d", recipe=FAST, init=chain)
    assert not any((tmp_path / name).exists() for name in "abcd")


def test_noise_needs_baselines(tmp_path) -> None:
    recipe = load_recipe(
        "published", ["training.noise=baselines", "generator.width=2", "training.iterations=1"]
    )
    few = [write_line(tmp_path / f"{k}.lh5", k, p, n=20) for k, p in ((1, None), (2, 4.0))]
    parts = ("2.lh5: no baselines to draw noise from", "training.noise=none")
    one_line(lambda: train(*few, tmp_path / "run", recipe=recipe, device="cpu"), *parts)
