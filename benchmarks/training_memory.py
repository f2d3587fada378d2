"""Memory of a training on a million simulated pulses.

Run with ``python benchmarks/training_memory.py --pulses 1000000``: writes a file of that many
simulated pulses of the full-energy peak and one of measured pulses, trains on them with
``cpunet train`` in a process of its own, and prints the peak resident memory.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.writing import PulseWriter

BLOCK = 4096
MEASURED = 4000
DT_NS = 16.0
PEAK_KEV = 2614.5
RUNS: dict[str, list[str]] = {
    # two iterations: the memory of a step is allocated after one
    "paper": ["training.iterations=2", "training.cycle_interval=1"],
    "fast": [],
}


def ramps(rng: np.random.Generator, n: int, samples: int) -> FloatArray:
    """Charge pulses that rise linearly, for 160 to 960 ns, up to the middle of the record."""
    rise = rng.uniform(10, 60, (n, 1)).astype(np.float32)
    time_samples = np.arange(samples, dtype=np.float32) - samples // 2
    clipped: FloatArray = np.clip(time_samples / rise + 1, 0, 1)
    return clipped


def write_simulation(path: Path, n: int) -> None:
    rng = np.random.default_rng(0)
    with PulseWriter(path) as writer:
        for first in range(0, n, BLOCK):
            size = min(BLOCK, n - first)
            writer.append(
                Pulses.of(
                    ramps(rng, size, 160), dt_ns=DT_NS, energy_kev=np.full(size, PEAK_KEV)
                )
            )


def write_data(path: Path) -> None:
    """Write ramps with a bandwidth of 60 ns, a decay of 100 us and noise."""
    rng = np.random.default_rng(1)
    pulses = ramps(rng, MEASURED, 1400)
    times = np.arange(1400) * DT_NS
    response = np.exp(-times / 1e5) - np.exp(-times / 60)
    spectrum = np.fft.rfft(np.gradient(response), 2800)
    shaped = np.fft.irfft(np.fft.rfft(pulses, 2800) * spectrum, 2800)[:, :1400]
    noisy = 14_000 * shaped + rng.normal(0, 5, pulses.shape)
    with PulseWriter(path, table="geds/raw") as writer:
        writer.append(
            Pulses.of(1000 + noisy, dt_ns=DT_NS, energy_kev=np.full(MEASURED, PEAK_KEV))
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pulses", type=int, default=1_000_000)
    parser.add_argument("--recipes", nargs="+", choices=list(RUNS), default=list(RUNS))
    given = parser.parse_args()
    command = [str(Path(sys.executable).parent / "cpunet"), "train"]
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name:
        folder = Path(name)
        write_simulation(folder / "sim.lh5", given.pulses)
        write_data(folder / "data.lh5")
        files = ["--sim", str(folder / "sim.lh5"), "--data", str(folder / "data.lh5")]
        for recipe in given.recipes:
            out = folder / recipe
            words = [f"--set={setting}" for setting in RUNS[recipe]]
            begin = time.perf_counter()
            subprocess.run(
                [*command, "--recipe", recipe, *files, "--out", str(out), *words], check=True
            )
            seconds = time.perf_counter() - begin
            run = json.loads((out / "run.json").read_text())
            memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
            print(
                f"{recipe}: {run['sim']['used']:,} simulated pulses, "
                f"peak {memory:.1f} GB, {seconds:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
