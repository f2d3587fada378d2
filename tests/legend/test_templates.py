"""Templates behind a readout chain: their place, height and begin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from torch import nn

from cpunet.legend.templates import TemplateTranslator
from cpunet.networks.generators import ResponseGenerator
from cpunet.recipes import load_recipe
from cpunet.translation.translator import REN
from synthetic import after_pole_and_decay, sampled, write_run

TAU_NS, DECAY_NS = 50.0, 60_000.0
R, Z = np.arange(3.0), np.arange(4.0)
FINE = 8  # samples of the charge to one of a template


def written(folder: Path, *overrides: str, stretch: float = 0.0) -> Path:
    """A run, sampled every 16 ns, that knows a pole of 50 ns and a decay of 60 µs."""
    known = ["generator.poles_ns=[50]", "generator.decay_us=60", *overrides]
    recipe = load_recipe("fast", known)
    generator = ResponseGenerator(recipe.matching.generator, 16.0)
    if generator.response.drift is not None:
        generator.response.drift.stretch.data.fill_(stretch)
    info = {"recipe": "fast", "peak": "FEP", "seed": 0, "dt_ns": 16.0}
    model = nn.ModuleDict({"ren": generator})
    write_run(folder, model, recipe, info | {"seconds": 1.0, "device": "cpu"})
    return folder


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("chain"))


@pytest.fixture(scope="module")
def stretched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, and charges drift for a tenth longer than simulated."""
    folder = tmp_path_factory.mktemp("stretched")
    return written(folder, "generator.drift_terms=1", stretch=0.1)


def fine_charge(n_samples: int, dt_ns: float, seed: int = 0) -> np.ndarray:
    """Charge (r, z, samples * FINE) of logistic edges at different times; two are outside."""
    rng = np.random.default_rng(seed)
    shape = (len(R), len(Z), 1)
    time = (np.arange(n_samples * FINE) + 0.5) * dt_ns / FINE
    rise, width = rng.uniform(400, 1000, shape), rng.uniform(30, 60, shape)
    charge = 1 / (1 + np.exp(-(time - rise) / width))
    charge[2, 3] = charge[0, 0] = np.nan
    return charge


def templates(n_samples: int, dt_ns: float) -> np.ndarray:
    return sampled(fine_charge(n_samples, dt_ns), FINE)


def responded(n_samples: int, dt_ns: float) -> np.ndarray:
    """The same behind the pole and the decay, by recursion in fine steps."""
    charge = fine_charge(n_samples, dt_ns)
    fine = after_pole_and_decay(charge, dt_ns / FINE, TAU_NS, DECAY_NS, middle=True)
    return sampled(fine, FINE)


@pytest.mark.parametrize("dt_ns", [1.0, 16.0])
def test_a_template_is_responded_to_in_its_place(chain, dt_ns):
    n_samples = int(3000 / dt_ns)
    charge = templates(n_samples, dt_ns)[1].astype(np.float32)
    translate = TemplateTranslator(REN.load(chain), dt_ns)
    result = translate(charge)
    # the pole was learned at 16 ns, and holds at 1 ns
    assert np.abs(result - responded(n_samples, dt_ns)[1]).max() < 1e-3
    # no alignment, no normalisation: half the charge is half the record
    half = translate(0.5 * charge)
    np.testing.assert_allclose(half, 0.5 * result, atol=1e-6)
    assert not translate(np.zeros_like(charge)).any()


@pytest.mark.parametrize("dt_ns", [1.0, 16.0])
def test_stretched_templates_keep_their_begin(chain, stretched, dt_ns):
    """They are summed by time, which counts from the begin of the drift."""
    time = dt_ns * np.arange(int(3000 / dt_ns))

    def drifting(long_ns: np.ndarray) -> np.ndarray:
        along = np.clip(time / long_ns[:, np.newaxis], 0, 1)
        return (along**3 * (10 - 15 * along + 6 * along**2)).astype(np.float32)

    long_ns = np.array([400.0, 900.0, 1700.0])
    found = TemplateTranslator(REN.load(stretched), dt_ns)(drifting(long_ns))
    expected = TemplateTranslator(REN.load(chain), dt_ns)(drifting(1.1 * long_ns))
    # the begin is known to a sample, of which a tenth is what it may be off
    steepest = np.abs(np.diff(expected, axis=1)).max()
    assert np.abs(found - expected).max() < 0.2 * steepest + 1e-3
    unstretched = TemplateTranslator(REN.load(chain), dt_ns)(drifting(long_ns))
    assert np.abs(unstretched - found).max() > 0.05
