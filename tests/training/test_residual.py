"""A correction is kept where the physics differ, and is nothing where they do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torch import nn

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import finish
from cpunet.errors import CpunetError
from cpunet.networks.hybrid import EdgeResidual
from cpunet.networks.linear_inverse import LinearInverse, Sizes
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import FloatArray
from cpunet.recipes import load_recipe
from cpunet.training.edge_functions import EdgeFunctions, EdgeMisfit
from cpunet.training.residual import Kept, fit_residual
from cpunet.training.run_folder import read_recipe, write_run
from cpunet.translation.translator import REN
from synthetic import two_sites

DT_NS, KEV, N = 16.0, 2614.5, 500
RECIPE = load_recipe(
    "best",
    [
        "generator.residual.iterations=80",
        "generator.residual.width=8",
        "generator.residual.batch_size=200",
        "generator.residual.rate=0.01",
        "generator.residual.average_decay=0.9",
        "generator.residual.roughness_weight=1",
    ],
)


def charge(n: int, seed: int, stretched: float = 1.0) -> FloatArray:
    """Windows of two-site charge pulses that end at the alignment; edges are stretched."""
    rng = np.random.default_rng(seed)
    time = np.arange(800)[np.newaxis] - 400

    def site() -> np.ndarray:
        width = stretched * rng.uniform(1.5, 4, (n, 1))
        return 1 / (1 + np.exp(-(time + rng.uniform(20, 60, (n, 1))) / width))

    return np.asarray(two_sites(rng, n, site), np.float32)


@pytest.fixture(scope="module")
def chain() -> ResponseGenerator:
    made = ResponseGenerator(RECIPE.matching.generator, DT_NS)
    # white, 1.5 keV RMS
    noise = BaselineNoise(np.full(65, 1.5**2), 128, DT_NS, 500)
    made.set_noise(noise)
    return made.requires_grad_(False)


def measured(chain: ResponseGenerator, pulses: FloatArray) -> FloatArray:
    records = chain(torch.from_numpy(pulses)).numpy()
    made = finish(
        records,
        RECIPE.preparation,
        dt_ns=DT_NS,
        noise=chain.noise,
        energy_kev=np.full(len(pulses), KEV),
        seed=4,
    )
    return made[np.isfinite(made).all(axis=1)]


def fitted(
    chain: ResponseGenerator, stretched: float, *overrides: str
) -> tuple[EdgeResidual, Kept]:
    recipe = RECIPE
    if overrides:
        recipe = load_recipe("best", overrides)
    data = measured(chain, charge(N, 2, stretched))
    return fit_residual(chain, charge(N, 1), data, np.full(N, KEV), recipe, seed=0)


@pytest.mark.thorough
def test_nothing_is_kept_where_the_physics_agree(chain):
    residual, kept = fitted(chain, 1.0)
    assert not kept.kept
    assert kept.rms == 0
    assert not residual.used
    assert not any(p.any() for p in residual.outlet.parameters())


@pytest.mark.thorough
def test_wider_edges_are_learned(chain, tmp_path):
    residual, kept = fitted(chain, 2.2)
    assert kept.kept
    assert kept.held_out_after < 0.9 * kept.held_out_before
    assert kept.rms > 1e-3
    # pulses never seen get closer to what they are in truth
    with torch.no_grad():
        before = chain(torch.from_numpy(charge(200, 9)))
        wanted = chain(torch.from_numpy(charge(200, 9, 2.2)))
        after = residual(before)
    rms = [float((records - wanted).square().mean().sqrt()) for records in (before, after)]
    assert rms[1] < 0.96 * rms[0]
    assert_translated_alike(chain, residual, tmp_path / "run")


def assert_translated_alike(
    chain: ResponseGenerator, residual: EdgeResidual, folder: Path
) -> None:
    """A run that holds both translates as both do."""
    folder.mkdir()
    inverse = LinearInverse(Sizes.of(800, RECIPE.matching.training))
    model = nn.ModuleDict({"ren": chain, "iren": inverse, "residual": residual})
    info = {"recipe": "best", "peak": "FEP", "seed": 0, "dt_ns": DT_NS, "seconds": 1.0}
    write_run(folder, model, RECIPE, info | {"device": "cpu"})
    pulses = charge(5, 9)
    ren = REN.load(folder)
    with torch.no_grad():
        records = residual(chain(torch.from_numpy(pulses))).numpy()
    wanted = finish(records, RECIPE.preparation, dt_ns=DT_NS)
    np.testing.assert_allclose(ren.apply(pulses, noise=False), wanted, atol=1e-6)


def test_a_training_that_diverges_is_told(chain):
    with pytest.raises(CpunetError, match=r"^the residual diverged in iteration \d+; lower"):
        fitted(chain, 1.6, "generator.residual.rate=1e25", "generator.residual.iterations=5")


def test_recipes_without_a_residual(chain):
    with pytest.raises(CpunetError, match=r"^recipe fast: has no residual$"):
        _ = load_recipe("fast").residual


def test_same_physics_are_as_far_apart_as_chance(chain):
    functions = EdgeFunctions(measured(chain, charge(N, 2)), RECIPE)
    first, second = (functions.of_windows(measured(chain, charge(N, seed))) for seed in (2, 3))
    wider = functions.of_windows(measured(chain, charge(N, 3, 1.3)))
    misfit = EdgeMisfit(first, RECIPE.matching.training.ridge)
    same, other = (
        float(misfit(values.mean(dim=0), first.mean(dim=0), N / 2))
        for values in (second, wider)
    )
    assert 0.5 < same < 1.5
    assert other > 3 * same


def test_recipes_of_former_versions_are_read(tmp_path):
    settings = RECIPE.model_dump(mode="json")
    residual = settings["generator"]["residual"]
    del residual["roughness_weight"], residual["weight_decay"]
    former = {"projections": 64, "size_weight": 1e3, "slope_weight": 30.0}
    residual |= former | {"amplitude_weight": 1.0}
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(settings))
    assert read_recipe(tmp_path).residual.width == RECIPE.residual.width
    del residual["projections"]
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(CpunetError, match=r"residual\."):
        read_recipe(tmp_path)
