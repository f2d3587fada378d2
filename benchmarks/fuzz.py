"""Run every command on thousands of broken inputs, and check how each call ends.

Run with ``python benchmarks/fuzz.py --cases 2000 --seed 1``.  Small valid inputs are made once
(kept in ``--base``).  Each case changes one of them (``mutations.py``), an option, a name, a
cache or an environment variable, and calls one command in a process of its own: a fork of this
process, which has imported everything, or a new interpreter if the environment changes.
These faults are counted: tracebacks (including those that the command line reports as a bug),
crashes by a signal, wrong exit statuses, more or less than one line of error, outputs or
partial files left by a failure, changed inputs, success although the change makes no sense,
failure although it must not matter, more than 2 GB of memory, and more than 30 s of processor
time or of time not spent waiting for a core.  ``--only 17`` repeats one case and shows its
output; ``--part surroundings`` draws from a part of the kinds.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import fuzz_cases
import fuzz_surroundings
import numpy as np
from fuzz_inputs import make_base
from fuzz_process import Case, Outcome, run

MAX_KB = 2_000_000


def listing(folder: Path) -> dict[str, str]:
    """Digests of all files below a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or not path.is_file():
            found[str(path.relative_to(folder))] = "link" if path.is_symlink() else "other"
        else:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            found[str(path.relative_to(folder))] = digest
    return found


def judged(case: Case, outcome: Outcome, before: dict, after: dict) -> list[str]:
    """Faults of an outcome; usually none."""
    faults = []
    status, err = outcome.status, outcome.err
    lines = err.splitlines()
    errors = sum(line.startswith("error: ") for line in lines)
    # `check` lists its findings in lines of its own, and exits with 1
    found = status == 1 and case.words[0] == "check" and "Traceback" not in err
    if outcome.late:
        faults.append("over 30 s")
    elif status < 0:
        faults.append("crash")
    elif "Traceback" in err or status in (70, 97, 98, 99):
        faults.append("traceback")
    elif status not in (0, 2, 141) and not found:
        faults.append("wrong status")
    elif (
        status
        and not found
        and not case.closed.startswith("errors")
        and not 1 <= errors <= (3 if "files failed" in err else 1)
    ):
        faults.append("not one line")
    if outcome.kb > MAX_KB:
        faults.append("over 2 GB")
    if status == 0 and case.must_fail:
        faults.append("wrong success")
    if status and case.must_succeed:
        faults.append("wrong failure")
    # with --resume, the command may change its own earlier output
    own = case.words[case.words.index("--out") + 1] if "--resume" in case.words else None
    changed = [name for name in before if after.get(name) != before[name]]
    changed = [name for name in changed if own is None or not name.startswith(own.rstrip("/"))]
    if changed:
        faults.append(f"input changed ({changed[0]})")
    new = sorted(after.keys() - before.keys())
    if status and own is None and not found and not outcome.late and new:
        faults.append(f"leftover ({new[0]})")
    return faults


def imported() -> None:
    """Import all modules, so that forks need not."""
    import pkgutil

    import torch

    import cpunet

    for module in pkgutil.walk_packages(cpunet.__path__, "cpunet."):
        if not module.name.endswith("__main__"):
            try:
                __import__(module.name)
            except ImportError as error:  # of a package that is not installed
                print(error, file=sys.stderr)
    torch.set_num_threads(1)


def prepared(base: Path) -> None:
    """Make valid inputs and caches, if there are none yet."""
    os.environ["CPUNET_CACHE"] = str(base / "cache")
    if (base / "valid").is_dir():
        return
    making = base / "making"
    shutil.rmtree(making, ignore_errors=True)
    making.mkdir(parents=True)
    make_base(making)
    for name in (".stdout", ".stderr"):
        (making / name).unlink()
    making.replace(base / "valid")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", type=int, action="append")
    parser.add_argument("--part", choices=("all", "files", "surroundings"), default="all")
    parser.add_argument(
        "--base", type=Path, default=Path(tempfile.gettempdir()) / "cpunet-fuzz"
    )
    given = parser.parse_args()
    imported()
    prepared(given.base)
    parts = {"files": fuzz_cases.kinds(), "surroundings": fuzz_surroundings.KINDS}
    chances = parts.get(given.part) or [kind for part in parts.values() for kind in part]
    weights = np.array([weight for weight, _ in chances])
    counts: Counter[str] = Counter()
    commands: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    begun = time.monotonic()
    numbers = given.only or range(given.first, given.first + given.cases)
    for done, number in enumerate(numbers, 1):
        rng = np.random.default_rng([given.seed, number])
        with tempfile.TemporaryDirectory(dir=given.base) as name:
            folder, logs = Path(name) / "in", Path(name)
            shutil.copytree(given.base / "valid", folder, symlinks=True)
            kind = chances[int(rng.choice(len(chances), p=weights / weights.sum()))][1]
            case = kind(folder, rng)
            for left in (".stdout", ".stderr"):
                (folder / left).unlink(missing_ok=True)
            before = listing(folder)
            outcome = run(case, folder, logs)
            faults = judged(case, outcome, before, listing(folder))
        counts["success" if outcome.status == 0 else "error"] += 1
        commands[case.words[0]] += 1
        seconds[case.words[0]] += outcome.cpu_s
        for fault in faults:
            counts[fault.partition(" (")[0]] += 1
        if faults or given.only:
            line = (outcome.err.splitlines() or [""])[-1]
            print(f"{number}: {', '.join(faults)}: {case.told!r}\n    {line[:300]}", flush=True)
        if given.only:
            print([word[:200] for word in case.words], outcome, sep="\n")
        elif done % 100 == 0:
            print(f"{done} cases, {time.monotonic() - begun:.0f} s", flush=True)
    print({name: f"{n}, {seconds[name] / n:.1f} s" for name, n in commands.most_common()})
    print(f"{len(numbers)} cases in {time.monotonic() - begun:.0f} s: {dict(counts)}")


if __name__ == "__main__":
    main()
