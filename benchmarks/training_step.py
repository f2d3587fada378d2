"""Time of an iteration of a CycleGAN, as published or mended, with memory.

Run with ``python benchmarks/training_step.py --recipe published --width 8 40 --threads 1``;
``--device cuda`` does so on a GPU.  Pulses are ramps, behind a decay on the measured side.
Iterations are those of the recipe in turn, whose critics and cycles may have longer intervals.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time

import numpy as np
import torch

from cpunet.electronics.baseline_noise import BaselineNoise, record_samples
from cpunet.electronics.drawn_pile_up import TraceNoise
from cpunet.processes import keep_freed_memory
from cpunet.recipes import load_recipe
from cpunet.training.adversarial import Game
from cpunet.training.network_runs import generators
from cpunet.training.sides import Side, Sides

DT_NS, KEV, N, DECAY = 16.0, 2614.5, 512, 1 / 3000
FIRST = 2  # iterations that are not timed


def game_of(name: str, width: int, device: str) -> Game:
    """A game on ramps."""
    recipe = load_recipe(name, {"generator.width": width}).at(DT_NS)
    length, rng = recipe.preparation.length, np.random.default_rng(0)
    time_samples = np.arange(length) - length / 2
    charge = np.clip(time_samples / rng.uniform(20, 90, (2, N, 1)) + 1, 0, 1)
    charge[1] *= np.exp(-DECAY * np.clip(time_samples, 0, None))
    held = round((1 - recipe.training.held_out) * N)
    kev = np.full(N, KEV)
    pair = (Side(torch.from_numpy(side).float().to(device), kev, held) for side in charge)
    bins = record_samples(DT_NS) // 2 + 1
    white = BaselineNoise(np.full(bins, 2.0), record_samples(DT_NS), DT_NS, 100)
    noise = None if recipe.training.noise == "none" else TraceNoise(white)
    made = generators(recipe, DECAY)
    scaled = recipe.generator.linear != "none"
    sides = Sides(*pair, recipe.preparation, noise, scaled)
    return Game(made["ren"], made["iren"], sides, recipe.cyclegan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recipe", nargs="+", default=["published", "paper"])
    parser.add_argument("--width", type=int, nargs="+", default=[8])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=6)
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    keep_freed_memory()
    print(f"{given.device}, {given.threads} thread(s)")
    print(f"{'':<24}{'s':>8}{'CPU s':>8}")
    for name in given.recipe:
        for width in given.width:
            game = game_of(name, width, given.device)
            for _ in range(FIRST):
                game.step()
            begin = time.perf_counter(), time.process_time()
            for _ in range(given.repeats):
                game.step()
            if given.device.startswith("cuda"):
                torch.cuda.synchronize()
            took = time.perf_counter() - begin[0], time.process_time() - begin[1]
            wall, cpu = (seconds / given.repeats for seconds in took)
            print(f"{f'{name}, width {width}':<24}{wall:>8.3g}{cpu:>8.3g}")
    unit = 2**30 if sys.platform == "darwin" else 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    print(f"peak memory {peak:.2f} GB")


if __name__ == "__main__":
    main()
