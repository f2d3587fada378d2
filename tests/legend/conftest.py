"""A readout chain with slow parts."""

from __future__ import annotations

from pathlib import Path

import pytest

from cpunet.networks.generators import ResponseGenerator
from synthetic import write_chain


@pytest.fixture(scope="session")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, sampled every 16 ns, with two poles, slow parts and decays."""

    def slow(chain: ResponseGenerator) -> None:
        chain.response.slow_weights[2] = 0.03
        chain.response.decay_weights[0] = 0.05

    settings = ("generator.poles_ns=[45,30]", "generator.decay_us=60")
    return write_chain(tmp_path_factory.mktemp("chain"), *settings, change=slow)
