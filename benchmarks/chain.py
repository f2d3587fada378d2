"""Rates and memory of the chain: steps → pulses → raw traces → parameters.

Run with ``python benchmarks/chain.py``.  The two sizes in ``--events 4000,40000`` separate the
cost per event from the fixed cost, and the total is extrapolated to a million events.  As in
the workflow, each stage runs in a process of its own, with one thread.  The time is processor
time, which other load on the machine hardly changes; the memory is the maximum of the process.
Steps are those of gammas in the crystal from the built-in Monte Carlo, in the format of remage.
The run is an untrained readout chain: neither rate nor memory depends on its parameters.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import lh5
import numpy as np
from lgdo import Array, Table, VectorOfVectors
from streaming import write_fast_run

from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.simulate import GammaSource, energy_windows

ROOT = Path(__file__).resolve().parents[1]
POOL = 500  # different events; the file repeats them
DSP = ROOT / "workflow" / "scripts" / "dsp.py"
CONFIG = ROOT / "workflow" / "config" / "dsp.yaml"
MILLION = 1_000_000


class Cost(NamedTuple):
    """Processor time in s and peak resident memory in MB of a process."""

    seconds: float
    megabytes: float


def some_hits(seed: int) -> Hits:
    """Events of the full-energy peak and of the continuum."""
    windows = energy_windows("FEP,1000-2600", load_recipe("fast").peaks, 0.5)
    events = dict(zip(windows, (POOL // 5, POOL - POOL // 5), strict=True))
    source = GammaSource(events, 20.0, 5.0, seed)
    return Hits.concatenate(list(source.open(read_detector("icpc")).blocks))


def write_steps(path: Path, pool: Hits, n_events: int, block: int = 20_000) -> int:
    """Write the events, repeated, as a remage table; return the number of steps."""
    path.unlink(missing_ok=True)
    n_steps = 0
    for first in range(0, n_events, block):
        hits = pool[np.arange(first, min(first + block, n_events)) % len(pool)]
        n_steps += len(hits.edep_kev)
        table = Table({"evtid": Array(np.arange(first, first + len(hits)))})
        columns = {"xloc": hits.x_mm, "yloc": hits.y_mm, "zloc": hits.z_mm}
        for name, values in [*columns.items(), ("edep", hits.edep_kev)]:
            in_unit = (values, "keV") if name == "edep" else (1e-3 * values, "m")
            flat = Array(in_unit[0], attrs={"units": in_unit[1]})
            vectors = VectorOfVectors(
                flattened_data=flat, cumulative_length=Array(hits.offsets[1:])
            )
            table.add_field(name, vectors)
        lh5.write(table, "V01", str(path), group="stp", wo_mode="append")
    return n_steps


# Runs a program and prints its own peak memory.  The usage that the system reports includes the
# memory of the parent, from which it was forked.
RUNNER = """
import runpy, sys
from pathlib import Path
sys.argv = sys.argv[1:]
try:
    if sys.argv[0] == "cpunet":
        from cpunet.cli import main
        main()
    else:
        runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    told = Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]
    sys.stderr.write(f"\\nVmHWM {told}\\n")
"""


def measured(*words: object) -> Cost:
    """Run a program to its end, and return its cost."""
    process = subprocess.Popen(
        [sys.executable, "-c", RUNNER, *(str(word) for word in words)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env=os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )
    assert process.stderr is not None
    said = process.stderr.read().decode()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(said)
    kilobytes = float(said.rpartition("VmHWM ")[2])
    return Cost(usage.ru_utime + usage.ru_stime, kilobytes / 1024)


def chain(folder: Path, steps: Path) -> dict[str, Cost]:
    """Run each stage of the chain on one file."""
    pulses, raw, dsp = (folder / f"{name}.lh5" for name in ("pulses", "raw", "dsp"))
    simulate = ["simulate", "--detector", "icpc", "--hits", steps, "--hits-detector", "V01"]
    translate = ["translate", folder / "run", pulses, "--adc"]
    translate += ["--adc-per-kev", 10, "--baseline", 10000, "--out-table", "V01/raw"]
    parameters = [DSP, raw, dsp, "--config", CONFIG, "--table", "V01/raw"]
    return {
        "pulses": measured("cpunet", *simulate, "--out", pulses, "--force"),
        "raw traces": measured("cpunet", *translate, "--out", raw, "--force"),
        "parameters": measured(*parameters, "--run", folder / "run", "--tau-us", 400),
    }


def told(step: str, few: int, many: int, first: Cost, last: Cost) -> str:
    """Format a row of the table: cost per event, and fixed cost."""
    each = (last.seconds - first.seconds) / (many - few)
    once = first.seconds - few * each
    rate = f"{1 / each:.0f}" if each > 0 else "–"
    hours = (once + MILLION * max(each, 0.0)) / 3600
    sizes = f"{few}: {first.megabytes:.0f}, {many}: {last.megabytes:.0f}"
    return f"| {step} | {rate} | {once:.1f} | {sizes} | {hours:.2f} |"


def main() -> None:
    """Measure two sizes, and print the table of the documentation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", default="4000,40000")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    few, many = (int(n) for n in given.events.split(","))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_fast_run(folder / "run")
        pool, steps = some_hits(given.seed), folder / "stp.lh5"
        write_steps(steps, pool, 200)
        chain(folder, steps)  # compiles
        costs = []
        for n in (few, many):
            n_steps = write_steps(steps, pool, n)
            costs.append(chain(folder, steps))
            print(f"{n} events, {n_steps} steps: {costs[-1]}", flush=True)
        print("| step | events/s | once (s) | memory (MB) at events | 1M events (h) |")
        for step in costs[0]:
            print(told(step, few, many, costs[0][step], costs[1][step]))


if __name__ == "__main__":
    main()
