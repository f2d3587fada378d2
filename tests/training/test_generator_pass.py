"""Other precisions and compiled passes against the plain one."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from cpunet.training.cyclegan import CycleGan, Step

# torch's own compiler uses what it deprecates
pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")


def quiet(model: CycleGan) -> CycleGan:
    """Without latent noise, whose draws a compiled pass makes in another way."""
    for network in (model.ren, model.iren):
        nn.init.zeros_(network.latent_log_variance.weight)
        nn.init.constant_(network.latent_log_variance.bias, -200.0)
    return model


def outcome(tiny, sets, *settings: str) -> tuple[Tensor, Tensor]:
    """Translations, and the gradient of the identity losses."""
    recipe = tiny("generator.width=4", "generator.dropout=0", *settings)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = quiet(CycleGan(recipe).train())
        step = Step(model, recipe.cyclegan.training)
        losses, fakes = step.generator_losses(
            *(torch.from_numpy(pulses[:8, None]) for pulses in sets)
        )
        (losses["identity_data"] + losses["identity_sim"]).backward()
    gradient = torch.cat([p.grad.flatten() for p in model.generator_parameters()])
    return fakes["data"].detach(), gradient


@pytest.mark.slow  # minutes of compiling
@pytest.mark.filterwarnings("ignore")  # torch's compiler warns of what it does itself
def test_a_compiled_pass_is_the_plain_one(tiny, sets):
    for found, expected in zip(
        outcome(tiny, sets, "training.compiled=true"), outcome(tiny, sets), strict=True
    ):
        assert torch.allclose(found, expected, atol=1e-4 * float(expected.abs().max()))


def test_bf16_has_the_direction_of_the_gradient(tiny, sets):
    found, expected = outcome(tiny, sets, "training.precision=bf16"), outcome(tiny, sets)
    assert all(value.dtype == torch.float32 for value in found)
    assert float((found[0] - expected[0]).norm() / expected[0].norm()) < 0.05
    assert torch.cosine_similarity(found[1], expected[1], dim=0) > 0.95
    assert not torch.equal(found[1], expected[1])
