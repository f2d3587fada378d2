"""Compile once what tests use: loops of other packages and of our own, and bytecode.

An installation for development runs this (``make install-dev``).  Whatever is missing is
compiled by the process that needs it, as in a first run of the program.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
# What other packages compile when it is imported or first called, a minute in all; half in each
# process.  Two processes that compile the same may each be given the other's code, and crash.
OTHERS = (
    "import lh5.compression.radware, dspeed.processors.moving_windows, "
    "dspeed.processors.pole_zero, dspeed.processors.trap_filters",
    """
import dspeed.processors.min_max, dspeed.processors.time_point_thresh
import dspeed.processors.upsampler, lh5.compression.varlen
import numpy as np
from lgdo import VectorOfVectors
ends = np.array([1, 3], np.uint32)
VectorOfVectors(flattened_data=np.ones(3, np.uint8), cumulative_length=ends).to_aoesa()
""",
)
# Commands, run in one folder, that need nearly all loops of our own; half in each process.
OWN = (
    "stand --preset legend200 --events FEP=400 --out stand"
    "; train --sim stand/sim.lh5 --data stand/data.lh5 --out run"
    "; validate run --sim stand/sim.lh5 --data stand/data.lh5 --no-baselines --out report",
    "simulate --detector ppc --hits hits.npz --out few.lh5"
    "; library make --detector ppc --grid-mm 5 --out library.lh5"
    "; info ppc --out fields.png",
)
RUN = """
import sys
from cpunet.cli import run
for command in sys.argv[1:]:
    run(command.split())
"""


def run(programs: list[list[str]], folder: Path) -> bool:
    """Whether Python does all this, at once."""
    running = [
        subprocess.Popen([sys.executable, *words], cwd=folder, stdout=subprocess.DEVNULL)
        for words in programs
    ]
    codes = [process.wait() for process in running]
    return not any(codes)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="cpunet-compiled-") as name:
        folder = Path(name)
        places = {"x_mm": [10.0, 12.0], "y_mm": [5.0, 5.0], "z_mm": [20.0, 21.0]}
        np.savez(folder / "hits.npz", **places, edep_keV=[900.0, 300.0], offsets=[0, 2])
        if not run([["-c", program] for program in OTHERS], folder):
            sys.exit("error: lh5, dspeed or lgdo cannot be imported")
        collect = ["-m", "pytest", "--collect-only", "-q", str(ROOT / "tests")]
        # if a command fails, tests tell what is wrong
        run([*(["-c", RUN, *commands.split("; ")] for commands in OWN), collect], folder)
