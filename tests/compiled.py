"""Compiled code that the tests share: loops of other packages and of our own, and bytecode.

All is kept for later runs.  An installation for development makes them (``make install-dev``
runs this module), as a first run of the program does; whatever is missing is compiled by the
process that needs it.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy as np
import platformdirs

ROOT = Path(__file__).parents[1]
# What other packages compile when it is imported or first called, a minute in all; half in each
# process.
OTHERS = (
    "import lh5.compression.radware, dspeed.processors.moving_windows",
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
    "simulate --detector ppc --hits hits.npz --library --out library.lh5"
    "; fields ppc --out fields.png",
)
RUN = """
import sys
from cpunet.cli.main import app
for command in sys.argv[1:]:
    app(command.split(), standalone_mode=False)
"""


class NotCompiledError(Exception):
    """What is compiled by others cannot be had: the installation is broken."""


def of_others() -> Path:
    """Folder of compiled code of other packages; made if there is none of these versions.

    Only copies of it are used: two processes that add code to one folder at once may each
    be given the other's, and crash.
    """
    from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

    packages = ("numba", "llvmlite", "numpy", "dspeed", "legend-lh5io", "legend-pydataobj")
    depends_on = [sys.version, sys.prefix, *map(version, packages), *OTHERS]
    depends_on += [get_host_cpu_name(), get_host_cpu_features().flatten()]
    key = hashlib.sha256(repr(depends_on).encode()).hexdigest()[:16]
    made = platformdirs.user_cache_path("cpunet") / "tests" / key
    made.parent.mkdir(parents=True, exist_ok=True)
    with made.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            aside = Path(tempfile.mkdtemp(dir=made.parent))
            compiling = [
                subprocess.Popen(
                    [sys.executable, "-c", program],
                    env=os.environ | {"NUMBA_CACHE_DIR": str(aside)},
                )
                for program in OTHERS
            ]
            ended = [process.wait() for process in compiling]
            if any(ended):
                shutil.rmtree(aside)
                raise NotCompiledError(
                    "lh5, dspeed or lgdo cannot be imported: run make install-dev"
                )
            aside.replace(made)
    return made


def share(own: Path, others: Path) -> None:
    """Fill a process's folder of compiled code: a copy of others', and links to our own."""
    from numba.core.caching import _CacheLocator

    import cpunet

    shutil.copytree(others, own)
    for folder in {file.parent for file in Path(cpunet.__file__).parent.rglob("*.py")}:
        kept = folder / "__pycache__"
        kept.mkdir(exist_ok=True)
        name = _CacheLocator.get_suitable_cache_subpath(str(folder / "any.py"))
        (own / name).symlink_to(kept)


def make_all() -> None:
    """Run commands that need the package's own loops, and collect the tests.

    One that fails is warned about: what it would have compiled, tests compile.
    """
    with tempfile.TemporaryDirectory(prefix="cpunet-compiled-") as name:
        folder = Path(name)
        share(folder / "code", of_others())
        np.savez(
            folder / "hits.npz",
            x_mm=[10.0, 12.0],
            y_mm=[5.0, 5.0],
            z_mm=[20.0, 21.0],
            edep_keV=[900.0, 300.0],
            offsets=[0, 2],
        )
        programs = [(["-c", RUN, *commands.split("; ")], folder) for commands in OWN]
        programs.append((["-m", "pytest", "--collect-only", "-q"], ROOT))
        running = [
            subprocess.Popen(
                [sys.executable, *words],
                cwd=place,
                env=os.environ | {"NUMBA_CACHE_DIR": str(folder / "code")},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
            for words, place in programs
        ]
        for process in running:
            _, told = process.communicate()
            if process.returncode:  # tests compile what they need, and tell what is wrong
                warnings.warn(f"not all is compiled beforehand: {told.strip()}", stacklevel=1)


if __name__ == "__main__":
    try:
        make_all()
    except NotCompiledError as error:
        sys.exit(f"error: {error}")
