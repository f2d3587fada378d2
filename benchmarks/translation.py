"""Rate of translation of prepared pulses: readout chain with noise, and U-Nets.

Run with ``python benchmarks/translation.py``, on one core, or with ``--threads 2``; each rate
is the median of three.  The reference is the U-Net of recipe `paper` in eager float32; it and
the one with fast convolutions take turns.  With ``--device cuda`` there is only one
implementation of a U-Net; ``--pulses 4096`` then keeps the GPU busy.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.networks.time_major import FrozenUNet, fast_passes_pay
from cpunet.recipes import load_recipe
from cpunet.translation.backends import NetworkBackend, ResponseBackend

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


def unets(pulses: np.ndarray, device: str) -> tuple[float, float, float]:
    """Pulses per second of the large U-Net, eager and fast, and largest relative difference."""
    torch.manual_seed(0)
    network = PositionalUNet(load_recipe("paper").cyclegan.generator, 800).eval().to(device)
    batch = torch.from_numpy(pulses)[:, None].to(device)
    if not fast_passes_pay(network, device):
        with torch.inference_mode():  # copied to the host, so that the GPU has finished
            eager = rate(lambda: network(batch, mean=True).cpu(), len(pulses))
        return eager, eager, 0.0
    ways = (partial(network, batch), partial(FrozenUNet(network).translate, batch))
    times: tuple[list[float], list[float]] = ([], [])
    with torch.inference_mode():
        plain, fast = (way(mean=True) for way in ways)
        for _ in range(REPEATS):
            for way, own in zip(ways, times, strict=True):
                begin = time.perf_counter()
                way()
                own.append(time.perf_counter() - begin)
    slow_rate, fast_rate = (len(pulses) / float(np.median(own)) for own in times)
    return slow_rate, fast_rate, float((plain - fast).abs().max() / plain.abs().max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--pulses", type=int, default=32, help="of a batch of the large U-Net")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    fast = load_recipe("fast")
    chain = ResponseGenerator(fast.matching.generator, DT_NS).to(given.device)
    chain.set_noise(BaselineNoise(np.ones(4097), 8192, DT_NS, 100))
    response = ResponseBackend(chain, fast.preparation)
    pulses, energies = windows(8192), np.full(8192, FEP_KEV)
    blocks = [slice(first, first + 512) for first in range(0, len(pulses), 512)]
    generator = torch.Generator().manual_seed(0)

    def with_noise(noise: bool) -> None:
        for rows in blocks:
            response(pulses[rows], energies[rows], noise, generator)

    with torch.inference_mode():
        noisy = rate(lambda: with_noise(True), len(pulses))
        clean = rate(lambda: with_noise(False), len(pulses))
        recipe = load_recipe("paper", ["generator.width=8"])
        unet = PositionalUNet(recipe.cyclegan.generator, 800).to(given.device)
        network, generator = NetworkBackend(unet), torch.Generator(given.device)
        small = rate(partial(network, pulses[:512], None, True, generator), 512)
    plain, fast_unet, distance = unets(windows(given.pulses), given.device)
    print(f"{given.device}, {given.threads} thread(s)")
    print(f"{'method':<34}{'pulses/s':>10}{'ratio':>8}")
    for name, value in (
        ("readout chain, with noise", noisy),
        ("readout chain, without", clean),
        ("U-Net of width 8", small),
        ("U-Net of recipe paper, eager", plain),
        ("U-Net of recipe paper", fast_unet),
    ):
        print(f"{name:<34}{value:>10,.0f}{value / plain:>8.1f}")
    print(f"largest difference of the last two: {distance:.1e} of the largest value")


if __name__ == "__main__":
    main()
