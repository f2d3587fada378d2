"""Time of a CycleGAN training step: in float32, in bf16, and compiled.

Run with ``python benchmarks/training_step.py --recipe paper --width 8 40 --threads 1``.  Each
variant runs in a process of its own; they take turns, so that other load on the machine affects
all of them, and medians are compared.  Processor time is given besides, which depends less on
other load.  No step updates the discriminators, which recipe `paper` does in one step of 30.

``--steps float32 bf16 compiled bf16-compiled`` compares precisions and torch.compile, and
``--device cuda`` does so on a GPU.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import time
from multiprocessing.connection import Connection

import numpy as np
import torch

from cpunet.processes import keep_freed_memory
from cpunet.recipes import load_recipe
from cpunet.training.cyclegan import CycleGan, Step

STEPS: dict[str, list[str]] = {
    "float32": [],
    "bf16": ["training.precision=bf16"],
    "compiled": ["training.compiled=true"],
    "bf16-compiled": ["training.precision=bf16", "training.compiled=true"],
}


def work(
    recipe_name: str, settings: list[str], threads: int, device: str, line: Connection
) -> None:
    """Do a step for each order "step" on a connection; end with the peak memory in GB."""
    torch.set_num_threads(threads)
    torch.set_default_device(device)
    torch.manual_seed(0)
    keep_freed_memory()
    recipe = load_recipe(recipe_name, settings).at(16)
    batch, length = recipe.cyclegan.training.batch_size, recipe.preparation.length
    rng = np.random.default_rng(0)
    ramps = (np.arange(length) - length / 2) / rng.uniform(20, 90, (2, batch, 1, 1)) + 1
    sim, data = torch.from_numpy(np.clip(ramps, 0, 1).astype(np.float32)).to(device)
    step = Step(CycleGan(recipe).train(), recipe.cyclegan.training)
    on_gpu = device.startswith("cuda")

    def timed() -> tuple[float, float]:
        begin = time.perf_counter(), time.process_time()
        step(1, sim, data)  # not one of those that update the discriminators
        if on_gpu:
            torch.cuda.synchronize()
        return time.perf_counter() - begin[0], time.process_time() - begin[1]

    for _ in range(2):
        timed()
    while line.recv() != "end":
        line.send(timed())
    if on_gpu:
        line.send(torch.cuda.max_memory_allocated() / 2**30)
        return
    unit = 2**30 if sys.platform == "darwin" else 2**20
    line.send(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recipe", default="paper")
    parser.add_argument("--width", type=int, nargs="+", default=[40])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", nargs="+", choices=list(STEPS), default=["float32"])
    given = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    lines: dict[str, Connection] = {}
    for width in given.width:
        for name in given.steps:
            near, far = context.Pipe()
            lines[f"{name}, width {width}"] = near
            settings = [*STEPS[name], f"generator.width={width}"]
            arguments = (given.recipe, settings, given.threads, given.device, far)
            context.Process(target=work, args=arguments, daemon=True).start()
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in lines}
    for _ in range(given.repeats):
        for name, line in lines.items():
            line.send("step")
            times[name].append(line.recv())
    print(f"recipe {given.recipe}, {given.device}, {given.threads} thread(s)")
    print(f"{'step':<28}{'s':>8}{'CPU s':>8}{'peak GB':>9}")
    for name, line in lines.items():
        line.send("end")
        wall, cpu = np.median(times[name], axis=0)
        print(f"{name:<28}{wall:>8.3g}{cpu:>8.3g}{line.recv():>9.2f}")


if __name__ == "__main__":
    main()
