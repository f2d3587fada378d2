"""Translate many files, kill the translation half-way, resume it, and compare the bytes.

Run with ``python benchmarks/resumed_translation.py --pulses 1000000 --files 10``.  Files of
analytic pulses are translated twice with ``cpunet translate``: without interruption, and killed
(SIGKILL, with all its processes) when half of the outputs exist and then resumed.  The run is
an untrained readout chain, as in ``streaming.py``.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from streaming import write_fast_run, write_input

CPUNET = str(Path(sys.executable).parent / "cpunet")


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each file."""
    found = {}
    for path in sorted(folder.glob("[!.]*.lh5")):
        with path.open("rb") as stream:
            found[path.name] = hashlib.file_digest(stream, "sha256").hexdigest()
    return found


def killed_half_way(words: list[str], out: Path, files: int) -> int:
    """Start a translation and kill it half-way; return the number of outputs."""
    process = subprocess.Popen(words, start_new_session=True, stderr=subprocess.DEVNULL)
    while process.poll() is None and len(list(out.glob("[!.]*.lh5"))) < files // 2:
        time.sleep(0.05)
    time.sleep(1.0)  # into the next file
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return len(digests(out))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pulses", type=int, default=100_000)
    parser.add_argument("--files", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name:
        folder = Path(name)
        write_fast_run(folder / "run")
        (folder / "sim").mkdir()
        for number in range(given.files):
            write_input(folder / "sim" / f"part{number:03}.lh5", given.pulses // given.files)
        words = [CPUNET, "translate", str(folder / "run"), str(folder / "sim" / "*.lh5")]
        words += ["--jobs", str(given.jobs), "--out"]
        begin = time.perf_counter()
        subprocess.run([*words, str(folder / "once")], check=True)
        seconds = time.perf_counter() - begin
        memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        expected = digests(folder / "once")
        out = folder / "resumed"
        there = killed_half_way([*words, str(out)], out, given.files)
        subprocess.run([*words, str(out), "--resume"], check=True)
        # names too: nothing of the killed processes is left
        same = digests(out) == expected and len(list(out.iterdir())) == given.files
    print(f"{given.pulses:,} pulses, {given.files} files, {given.jobs} processes")
    print(f"{seconds:.0f} s, {given.pulses / seconds:,.0f}/s, largest process {memory:.0f} MB")
    print(
        f"killed with {there} of {given.files} outputs written, resumed: "
        f"{'identical bytes' if same else 'OTHER BYTES'}"
    )
    sys.exit(not same)


if __name__ == "__main__":
    main()
