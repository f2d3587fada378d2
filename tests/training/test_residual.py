"""A correction is kept where the physics differ, and is nothing where they do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import finish
from cpunet.errors import CpunetError
from cpunet.networks.hybrid import EdgeResidual
from cpunet.networks.linear_inverse import LinearInverse, Sizes
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import FloatArray
from cpunet.recipes import load_recipe
from cpunet.training.residual import Kept, directions_of, fit_residual, quantiles
from cpunet.training.run_folder import write_run
from cpunet.translation.translator import REN

DT_NS, KEV, N = 16.0, 2614.5, 500
RECIPE = load_recipe(
    "best",
    [
        "generator.residual.iterations=80",
        "generator.residual.width=8",
        "generator.residual.batch_size=200",
        "generator.residual.rate=0.01",
        "generator.residual.average_decay=0.9",
        "generator.residual.size_weight=1",
        "generator.residual.slope_weight=0",
        "generator.residual.amplitude_weight=0.1",
    ],
)


def charge(n: int, seed: int, stretched: float = 1.0) -> FloatArray:
    """Windows of two-site charge pulses that end at the alignment; edges are stretched."""
    rng = np.random.default_rng(seed)
    time = np.arange(800)[np.newaxis] - 400

    def site() -> np.ndarray:
        width = stretched * rng.uniform(1.5, 4, (n, 1))
        return 1 / (1 + np.exp(-(time + rng.uniform(20, 60, (n, 1))) / width))

    share = np.where(rng.random((n, 1)) < 0.5, 1.0, rng.uniform(0.1, 0.9, (n, 1)))
    return np.asarray(share * site() + (1 - share) * site(), np.float32)


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


def test_nothing_is_kept_where_the_physics_agree(chain):
    residual, kept = fitted(chain, 1.0)
    assert not kept.kept
    assert kept.rms == 0
    assert not residual.used
    assert not any(p.any() for p in residual.outlet.parameters())


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


def test_quantiles_are_numpys():
    values = np.random.default_rng(0).normal(size=(700, 3)).astype(np.float32)
    found = quantiles(torch.from_numpy(values)).numpy()
    at = (np.arange(len(found)) + 0.5) / len(found)
    np.testing.assert_allclose(
        found, np.quantile(values, at, axis=0, method="hazen"), atol=1e-5
    )


def test_directions_mix_few_features():
    directions = directions_of(300, 41, torch.Generator().manual_seed(0))
    torch.testing.assert_close(directions.norm(dim=0), torch.ones(300))
    assert set((directions != 0).sum(dim=0).tolist()) == {1, 2, 3}
