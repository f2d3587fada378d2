"""Time and memory of a comparison of a thousand reports, and of a validation of many pulses.

Run with ``python benchmarks/load.py compare --reports 1000 --report REPORT`` for copies of a
report, or with ``validate --run RUN --sim SIM --data DATA --pulses 1000000``, which repeats the
pulses of two files until each side has that many.  Prints wall-clock time, processor time and
peak memory of the process, and the size of the page or the rejections of the validation.
The chain from steps to raw traces has a benchmark of its own, ``chain.py``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from validation import repeated

NAMES = "V{detector:02d}-p{period:02d}"
_CALL = """
import resource, sys, time
from cpunet.cli import main
begun = time.monotonic()
sys.argv = ["cpunet", *sys.argv[1:]]
try:
    main()
finally:
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(f"{time.monotonic() - begun:.1f} s, {used.ru_utime + used.ru_stime:.1f} CPU s, "
          f"{used.ru_maxrss / 1024:.0f} MB", file=sys.stderr)
"""


def call(*words: str | Path) -> None:
    """Run a command, and print the time and memory it took."""
    done = subprocess.run(
        [sys.executable, "-c", _CALL, *map(str, words)], check=True, capture_output=True
    )
    print(done.stderr.decode().splitlines()[-1])


def many_reports(report: Path, folder: Path, n: int) -> list[Path]:
    """Copy the scores of a report to folders of many detectors and periods."""
    scores = (report / "metrics.json").read_text("utf-8")
    made = []
    for number in range(n):
        name = NAMES.format(detector=number % 100, period=number // 100)
        (folder / name).mkdir()
        (folder / name / "metrics.json").write_text(scores, encoding="utf-8")
        made.append(folder / name)
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="what", required=True)
    one = commands.add_parser("compare")
    one.add_argument("--report", type=Path, required=True)
    one.add_argument("--reports", type=int, default=1000)
    two = commands.add_parser("validate")
    for name in ("--run", "--sim", "--data"):
        two.add_argument(name, type=Path, required=True)
    two.add_argument("--pulses", type=int, default=1_000_000)
    two.add_argument("--most", type=int, default=50_000)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.what == "compare":
            reports = many_reports(given.report, folder, given.reports)
            call("compare", *reports, "--out", folder / "all.html")
            print(f"{(folder / 'all.html').stat().st_size / 1e6:.1f} MB")
            return
        for side, noise in (("sim", 0.0), ("data", 1.0)):
            source = getattr(given, side)
            repeated(source, folder / f"{side}.lh5", given.pulses, noise=noise)
        files = ["--sim", folder / "sim.lh5", "--data", folder / "data.lh5"]
        files += ["--max-pulses", str(given.most)]
        call("validate", given.run, *files, "--no-baselines", "--out", folder / "report")
        scores = json.loads((folder / "report" / "metrics.json").read_text("utf-8"))
        print(scores["rejections"])


if __name__ == "__main__":
    main()
