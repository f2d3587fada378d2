"""Time and memory of a validation, against the number of pulses and of methods.

Run with ``python benchmarks/validation.py --pulses 6000 15000``: makes a stand and trains on
it, repeats its pulses until each side has that many, and runs ``cpunet validate`` on them in a
process of its own.  Prints wall-clock time, processor time and peak resident memory.  A folder
given by ``--folder`` is kept and reused.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.files import open_pulses
from cpunet.pulses.writing import PulseWriter

EVENTS = "FEP=1200,SEP=800,DEP=800"
BLOCK = 1024


def cpunet(*words: str) -> list[str]:
    return [str(Path(sys.executable).parent / "cpunet"), *words]


def make_run(folder: Path) -> None:
    stand, run = folder / "stand", folder / "run"
    made = ["stand", "--preset", "legend200", "--events", EVENTS, "--out", str(stand)]
    if not stand.exists():
        subprocess.run(cpunet(*made), check=True)
    files = ["--sim", str(stand / "sim.lh5"), "--data", str(stand / "data.lh5")]
    if not run.exists():
        subprocess.run(cpunet("train", *files, "--out", str(run)), check=True)


def repeated(source: Path, target: Path, n: int, *, noise: float) -> int:
    """Write `n` pulses, repeating those of the source, and return the number of the latter."""
    if target.exists():
        n_pulses = open_pulses(source).n_pulses
        assert n_pulses is not None
        return n_pulses
    blocks = list(open_pulses(source).blocks(BLOCK))
    every = Pulses.concatenate(blocks)
    rng = np.random.default_rng(0)
    is_raw = noise > 0
    with PulseWriter(
        target,
        table="geds/raw" if is_raw else "geds/sim",
        waveform_units="ADC" if is_raw else "",
        samples=np.uint16 if is_raw else np.float32,
    ) as writer:
        for first in range(0, n, BLOCK):
            rows = np.arange(first, min(first + BLOCK, n)) % len(every)
            block = every[rows]
            # copies of one trace would have equal parameters
            moved = block.waveforms + noise * rng.standard_normal(block.waveforms.shape)
            writer.append(block.with_waveforms(np.asarray(moved, np.float32)))
    return len(every)


def make_files(folder: Path, n: int) -> tuple[Path, Path, Path]:
    stand = folder / "stand"
    sim, data = (folder / f"{kind}_{n}.lh5" for kind in ("sim", "data"))
    truth = folder / f"truth_{n}.npz"
    there = repeated(stand / "sim.lh5", sim, n, noise=0)
    repeated(stand / "data.lh5", data, n, noise=1)
    if not truth.exists():
        with np.load(stand / "truth.npz") as file:
            np.savez(truth, response=file["response"][np.arange(n) % there])
    return sim, data, truth


def measured(command: list[str]) -> tuple[float, float, float]:
    """Wall-clock seconds, processor seconds and MB of the largest process."""
    begin = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)}: failed")
    wall = time.perf_counter() - begin
    return wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def validated(folder: Path, n: int, *, baselines: bool) -> str:
    sim, data, truth = make_files(folder, n)
    report = folder / f"report_{n}"
    words = ["--sim", str(sim), "--data", str(data), "--truth", str(truth)]
    words += ["--out", str(report), "--force", "--baselines" if baselines else "--no-baselines"]
    wall, cpu, memory_mb = measured(cpunet("validate", str(folder / "run"), *words))
    peaks = json.loads((report / "metrics.json").read_text())["peaks"]
    methods = max(len(peak.get("two_sample", {})) for peak in peaks.values())
    return (
        f"{n:6d} pulses, {methods} methods: {wall:6.1f} s, "
        f"{cpu:6.1f} s of processors, {memory_mb:5.0f} MB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pulses", type=int, nargs="+", default=[3000, 6000, 15000])
    parser.add_argument("--folder", type=Path, help="of stand and run, to be kept")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name:
        folder = given.folder or Path(name)
        folder.mkdir(exist_ok=True)
        make_run(folder)
        for n in given.pulses:
            for baselines in (False, True):
                print(validated(folder, n, baselines=baselines), flush=True)


if __name__ == "__main__":
    main()
