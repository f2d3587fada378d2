"""A linear inverse with weights whose effect is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cpunet.networks import generators
from cpunet.networks.generators import LinearInverse
from synthetic import load_recipe

# of 12, 20, 12 to 8, and 8 samples
STRETCHES = {"before_ns": 192, "after_ns": 320, "baseline_ns": (192, 128), "level_ns": 128}


def edges(*starts: int) -> npt.NDArray[np.float32]:
    """Ramps of four samples from 0 to 1."""
    time = np.arange(60, dtype=np.float32)
    return np.stack([((time - start) / 4).clip(0, 1) for start in starts])


def test_it_gives_back_what_it_gets_about_the_half_maximum_and_0_and_1_beyond(monkeypatch):
    monkeypatch.setattr(generators, "AFTER_NS", 128.0)
    config = load_recipe("fast").matching.training.model_copy(update=STRETCHES)
    identity = LinearInverse(60, config)
    identity.half_height[...] = 0.5
    identity.weights[...] = np.eye(20)
    pulses = 0.9 * edges(25, 30, 33) + np.float32(0.05)  # of any offset and height
    pulses[0, :5] += 0.2
    pulses[0, 55:] -= 0.3
    pulses[1] = float("nan")  # has nothing to say to others
    result = identity(pulses)
    assert result.dtype == np.float32
    assert np.isnan(result[1]).any()
    np.testing.assert_allclose(result[[0, 2]], edges(25, 33), atol=1e-5, rtol=1e-5)
