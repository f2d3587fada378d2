"""Rate of translation of prepared pulses: readout chain with noise, and U-Nets.

Run with ``python benchmarks/translation.py``, on one core, or with ``--threads 2``; each rate
is the median of three.  The reference is the U-Net of recipe `paper`.  On a GPU (``--device
cuda``), ``--pulses 4096`` keeps it busy.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.kernels import use_threads
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.recipes import load_recipe
from cpunet.training.adversarial import Generator
from cpunet.translation.backends import Batch, NetworkBackend, ResponseBackend

REPEATS = 3
DT_NS, FEP_KEV = 16.0, 2614.5


def windows(n: int) -> np.ndarray:
    """Prepared simulated pulses: ramps of random length."""
    rng = np.random.default_rng(0)
    length = rng.uniform(20, 90, (n, 1))
    return np.clip((np.arange(800) - 400) / length + 1, 0, 1).astype(np.float32)


def rate(translate: Callable[[], object], n: int) -> float:
    """Pulses per second, the median of a few runs."""
    translate()  # compiles, and fills caches
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        translate()
        times.append(time.perf_counter() - begin)
    return n / float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--pulses", type=int, default=32, help="of a batch of the large U-Net")
    given = parser.parse_args()
    use_threads(given.threads)
    fast = load_recipe("fast").at(16)
    chain = ResponseGenerator(fast.matching.generator, DT_NS)
    chain.set_noise(BaselineNoise(np.ones(4097), 8192, DT_NS, 100))
    response = ResponseBackend(chain, fast.preparation, DT_NS, chain.noise)
    pulses, energies = windows(8192), np.full(8192, FEP_KEV)
    blocks = [slice(first, first + 512) for first in range(0, len(pulses), 512)]
    generator = np.random.default_rng(0)

    def with_noise(noise: bool) -> None:
        for rows in blocks:
            response.translate(Batch(pulses[rows], energies[rows], noise, generator))

    def unet(width: int, n: int) -> float:
        recipe = load_recipe("published", [f"generator.width={width}"]).at(16)
        network = Generator(PositionalUNet(recipe.cyclegan.generator, 800)).to(given.device)
        backend = NetworkBackend(network.eval(), fast.preparation, DT_NS)
        return rate(partial(backend.translate, Batch(pulses[:n])), n)

    rates = {
        "readout chain, with noise": rate(lambda: with_noise(True), len(pulses)),
        "readout chain, without": rate(lambda: with_noise(False), len(pulses)),
        "U-Net of width 8": unet(8, 512),
        "U-Net of recipe paper": unet(40, given.pulses),
    }
    print(f"{given.device}, {given.threads} thread(s)")
    print(f"{'method':<34}{'pulses/s':>10}{'ratio':>8}")
    for name, value in rates.items():
        print(f"{name:<34}{value:>10,.0f}{value / rates['U-Net of recipe paper']:>8.1f}")


if __name__ == "__main__":
    main()
