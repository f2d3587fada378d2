"""Translate a long file, and record its memory: rate, peak, and a figure over time.

Run with ``python benchmarks/streaming.py``; ``--pulses 1000000`` for a million,
``--picture memory.png`` for the figure.  The run is an untrained
readout chain: neither rate nor memory depends on its parameters.  Pulses are analytic.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.kernels import use_threads
from cpunet.networks.generators import ResponseGenerator
from cpunet.pulses.container import Pulses
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes import load_recipe
from cpunet.training.run import Run
from cpunet.translation.options import Adc
from cpunet.translation.translate import translate
from cpunet.translation.translation import Translation

DT_NS, LENGTH, BLOCK = 16.0, 225, 4096
PAGE_MB = resource.getpagesize() / 2**20
Watched = list[tuple[float, float]]


def write_input(path: Path, n: int) -> None:
    """Write ramps of random length, block by block."""
    rng = np.random.default_rng(0)
    time_samples = np.arange(LENGTH)
    with PulseWriter(path) as writer:
        for first in range(0, n, BLOCK):
            size = min(BLOCK, n - first)
            rise = rng.uniform(10, 60, (size, 1)).astype(np.float32)
            ramps = np.clip((time_samples - 80) / rise + 1, 0, 1)
            pulses = Pulses.of(
                ramps,
                dt_ns=DT_NS,
                energy_kev=rng.uniform(500, 2700, size),
                event_number=np.arange(first, first + size),
            )
            writer.append(pulses, {"rise": (rise[:, 0], "")})


def write_fast_run(folder: Path) -> None:
    """Write an unfitted run of recipe `fast`, with white noise of 2 keV."""
    recipe = load_recipe("fast").at(16)
    chain = ResponseGenerator(recipe.matching.generator, DT_NS)
    chain.set_noise(BaselineNoise(np.full(4097, 4.0), 8192, DT_NS, 100))
    facts = {"dt_ns": DT_NS, "peak": "FEP", "seconds": 0, "seed": 0, "device": "cpu"}
    Run.of({"ren": chain}, recipe, **facts).save(folder)


@contextmanager
def watching() -> Iterator[Watched]:
    """Resident memory (s, MB) of this process, four times a second."""
    begin, seen, stop = time.perf_counter(), list[tuple[float, float]](), threading.Event()

    def watch() -> None:
        while True:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            seen.append((time.perf_counter() - begin, pages * PAGE_MB))
            if stop.wait(0.25):
                return

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield seen
    finally:
        stop.set()
        thread.join()


def draw(seen: Watched, n: int, path: Path) -> None:
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    seconds, memory = np.transpose(seen)
    figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
    axes.plot(seconds, memory, lw=1.2)
    axes.set(
        xlabel="time [s]",
        ylabel="resident memory [MB]",
        ylim=(0, 1.25 * memory.max()),
        title=f"cpunet translate, {n:,} pulses in one file",
    )
    figure.savefig(path, dpi=120)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--pulses", type=int, default=100_000)
    arguments.add_argument("--adc", action="store_true", help="raw traces of 1,400 samples")
    arguments.add_argument("--picture", type=Path)
    given = arguments.parse_args()
    use_threads(1)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name:
        folder = Path(name)
        write_fast_run(folder / "run")
        write_input(folder / "sim.lh5", given.pulses)
        scale = Adc(6.0, 15_000, 1400, 700) if given.adc else Adc()
        begin = time.perf_counter()
        with watching() as seen:
            result = translate(
                folder / "run",
                folder / "sim.lh5",
                folder / "out.lh5",
                adc=given.adc,
                scale=scale,
            )
        assert isinstance(result, Translation)
        counts, seconds = result.counts, time.perf_counter() - begin
        size = (folder / "out.lh5").stat().st_size
    memory = np.array([mb for _, mb in seen])
    quarter = max(1, len(memory) // 4)
    print(f"{counts.translated:,} pulses in {seconds:.0f} s: {counts.read / seconds:,.0f}/s")
    print(f"{size / given.pulses:,.0f} bytes a pulse")
    print(f"peak of memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    print(
        f"mean of the second quarter {memory[quarter : 2 * quarter].mean():.0f} MB, "
        f"of the last {memory[-quarter:].mean():.0f} MB"
    )
    if given.picture:
        draw(seen, given.pulses, given.picture)


if __name__ == "__main__":
    main()
