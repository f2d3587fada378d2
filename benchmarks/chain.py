"""Rates and memory of the chain of events: steps → pulses → raw traces → parameters.

Run with ``python benchmarks/chain.py``; ``--events 4000,40000`` gives two sizes, of which the
cost of an event and what is paid once are told apart, and scaled to a million.  Each step is a
process of its own, as in the workflow, with one thread: its time is that of the processor,
which others on the machine hardly change, its memory that process's maximum.  Steps are those
of gammas in the crystal, as the built-in Monte Carlo makes them, in the layout of remage.
The run is a readout chain that was not trained: neither rate nor memory depend on its numbers.
Pulses are drifted for each hit (exact, a tenth of the events) and interpolated in a library.
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

from cpunet.jobs.simulation.hit_sources import GammaSource, energy_windows
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits

ROOT = Path(__file__).resolve().parents[1]
POOL = 500  # different events; the file repeats them
DSP = ROOT / "workflow" / "scripts" / "dsp.py"
CONFIG = ROOT / "workflow" / "config" / "dsp.yaml"
MILLION = 1_000_000
TENTH = 10  # of the events are drifted one by one


class Cost(NamedTuple):
    """Processor time in s and largest resident memory in MB of a process."""

    seconds: float
    megabytes: float


def some_hits(seed: int) -> Hits:
    """Events of the full-energy peak and of the continuum."""
    windows = energy_windows("FEP,1000-2600", load_recipe("fast").peaks, 0.5)
    source = GammaSource(tuple(windows), (POOL // 5, POOL - POOL // 5), 20.0, 5.0, seed)
    return Hits.concatenate(list(source.open(read_detector("icpc")).blocks))


def write_steps(path: Path, pool: Hits, n_events: int, block: int = 20_000) -> int:
    """The events again and again, as a table of remage; returns the number of steps."""
    path.unlink(missing_ok=True)
    n_steps = 0
    for first in range(0, n_events, block):
        hits = pool[np.arange(first, min(first + block, n_events)) % pool.n_events]
        n_steps += len(hits.edep_kev)
        table = Table({"evtid": Array(np.arange(first, first + hits.n_events))})
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


# Runs a program and tells the largest memory of its own; that of the parent, from which it was
# forked, would count in the usage that the system tells.
RUNNER = """
import runpy, sys
from pathlib import Path
sys.argv = sys.argv[1:]
try:
    if sys.argv[0] == "cpunet":
        from cpunet.cli.main import main
        main()
    else:
        runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    told = Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]
    sys.stderr.write(f"\\nVmHWM {told}\\n")
"""


def measured(*words: object) -> Cost:
    """Run a program to its end."""
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


def simulated(folder: Path, steps: Path, mode: str) -> Cost:
    """Steps to pulses, drifted one by one or interpolated in a library."""
    words = ["--detector", "icpc", "--hits", steps, "--hits-detector", "V01", mode]
    return measured("cpunet", "simulate", *words, "--out", folder / "pulses.lh5", "--force")


def chain(folder: Path, steps: Path) -> dict[str, Cost]:
    """Each step of the chain on one file."""
    pulses, raw, dsp = (folder / f"{name}.lh5" for name in ("pulses", "raw", "dsp"))
    translate = ["translate", folder / "run", pulses, "--output", "adc"]
    translate += ["--adc-per-kev", 10, "--baseline", 10000, "--out-table", "V01/raw"]
    parameters = [DSP, raw, dsp, "--config", CONFIG, "--table", "V01/raw"]
    return {
        "pulses, library": simulated(folder, steps, "--library"),
        "raw traces": measured("cpunet", *translate, "--out", raw, "--force"),
        "parameters": measured(*parameters, "--run", folder / "run", "--tau-us", 400),
    }


def told(step: str, few: int, many: int, first: Cost, last: Cost) -> str:
    """A row of the table: what an event costs, and what is paid once."""
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
        simulated(folder, steps, "--exact")
        exact, costs = [], []
        for n in (few, many):
            write_steps(steps, pool, n // TENTH)
            exact.append(simulated(folder, steps, "--exact"))
            n_steps = write_steps(steps, pool, n)
            costs.append(chain(folder, steps))
            print(f"{n} events, {n_steps} steps: {costs[-1]}", flush=True)
        print("| step | events/s | once (s) | memory (MB) at events | 1M events (h) |")
        print(told("pulses, exact", few // TENTH, many // TENTH, *exact))
        for step in costs[0]:
            print(told(step, few, many, costs[0][step], costs[1][step]))


if __name__ == "__main__":
    main()
