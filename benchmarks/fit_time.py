"""Time and memory of a fit against the number of pulses.

Run with ``python benchmarks/fit_time.py STAND --pulses 1000 2000 5000 10000 20000``; STAND has
sim.lh5 and data.lh5 (``cpunet stand --events FEP=20000,…``).  If it has fewer pulses, they are
repeated, which does not affect time and memory.  Each fit runs in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from cpunet.electronics.measured import noise_of
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.training.chain_fit import Fitter
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_fit import fit_response


def first(pulses: Pulses, n: int) -> Pulses:
    rows = np.arange(n) % len(pulses)
    return Pulses.of(
        pulses.waveforms[rows], dt_ns=pulses.dt_ns, energy_kev=pulses.energy_kev[rows]
    )


def one(stand: Path, n: int) -> dict[str, float]:
    recipe = load_recipe("fast").at(16)
    selection = parse_selection("FEP", recipe.peaks)
    files = [PulseFile(stand / f"{side}.lh5") for side in ("sim", "data")]
    sim = load_pulses(files[0], "simulated", recipe, selection).prepared.pulses
    data = load_pulses(files[1], "measured", recipe, selection)
    noise = noise_of(data)
    sides = first(sim, n), first(data.prepared.pulses, n)
    loaded = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    wall, cpu = time.perf_counter(), time.process_time()
    sets = PulseSets(*sides, noise, recipe, np.random.default_rng(0))
    _, fit = fit_response(sets, Fitter(recipe.matching.training))
    return {
        "pulses": n,
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "before_mb": loaded,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "chi_square_per_moment": fit.chi_square_per_moment or 0.0,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stand", type=Path)
    parser.add_argument("--pulses", type=int, nargs="+", default=[1000, 2000, 5000, 20000])
    parser.add_argument("--one", action="store_true", help="in this process, as JSON")
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(one(arguments.stand, arguments.pulses[0])))
        return
    print("  pulses  wall s   cpu s  loaded MB  peak MB  chi2/moment")
    for n in arguments.pulses:
        command = [sys.executable, __file__, str(arguments.stand), "--pulses", str(n), "--one"]
        found = subprocess.run(command, check=True, capture_output=True, text=True)
        row = json.loads(found.stdout.splitlines()[-1])
        print(
            f"{n:8d}{row['wall_s']:8.1f}{row['cpu_s']:8.1f}{row['before_mb']:11.0f}"
            f"{row['peak_mb']:9.0f}{row['chi_square_per_moment']:13.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
