"""Run the workflow on SLURM to its end, through what happens on clusters.

Run with ``python benchmarks/slurm.py FOLDER`` where SLURM runs, by a user who may set nodes
down; with ``--status-command squeue`` where it has no accounting.  Three detectors in two
periods, each trained with two further seeds, on small test stands.  Trainings ask for too
little memory, are killed and tried again with twice as much; a node goes down under its jobs
and comes up again; a file without pulses fails one channel, and the others end all the same.
Then the file is mended, and a second run does the rest.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
DETECTORS, PERIODS, SEEDS = ("icpc", "bege", "ppc"), ("p03", "p04"), (1, 2)
FAILING = ("ppc", "p04")
DOWN_SECONDS = 45
LOGS = ".snakemake/slurm_logs/*/*/*.log"


def output(*words: str | Path) -> str:
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout


def prepare(folder: Path) -> Path:
    """Test stands and configuration; returns the file of data that is damaged."""
    for detector in DETECTORS:
        for seed, period in enumerate(PERIODS):
            stand = folder / "stands" / period / detector
            if not stand.exists():
                words = ("--detector", detector, "--seed", str(seed), "--out", stand)
                output(BIN / "cpunet", "stand", "--events", "FEP=300,SEP=60,DEP=60", *words)
    config = {
        "periods": {
            period: {"data": "stands/{period}/{detector}/data.lh5"} for period in PERIODS
        },
        "detectors": {
            d: {"simulations": f"stands/{PERIODS[0]}/{d}/sim.lh5"} for d in DETECTORS
        },
        "train": {
            "set": ["training.steps=1", "training.start_factors=[1.0]", "scores.bootstraps=20"]
        },
        "validate": {"baselines": False},
        "seeds": list(SEEDS),
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder / "stands" / FAILING[1] / FAILING[0] / "data.lh5"


def start(folder: Path, log: str, status_command: str) -> subprocess.Popen[bytes]:
    """Snakemake with the workflow's profile; a training fits into memory at a later try."""
    words = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "workflow" / "Snakefile")]
    words += ["--profile", str(ROOT / "workflow" / "profiles" / "slurm")]
    words += ["--configfile", "config.yaml", "--slurm-init-seconds-before-status-checks", "5"]
    words += ["--slurm-status-command", status_command, "--latency-wait", "5"]
    words += ["--set-resources", "train:mem_mb=250*attempt", "train_seed:mem_mb=250*attempt"]
    path = f"{BIN}{os.pathsep}{os.environ['PATH']}"
    with (folder / log).open("w") as printed:
        return subprocess.Popen(
            words,
            cwd=folder,
            env=os.environ | {"PATH": path},
            stdout=printed,
            stderr=subprocess.STDOUT,
        )


def running_validation() -> tuple[str, str] | None:
    """Number and node of a validation that runs."""
    for line in output("squeue", "--noheader", "--states=R", "--format=%i|%N|%k").splitlines():
        job, node, comment = line.split("|")
        if comment.startswith("rule_validate"):
            return job, node
    return None


def set_down_and_up(process: subprocess.Popen[bytes]) -> tuple[str, str]:
    """Set the node of a validation down and up again; returns number and node."""
    while (job := running_validation()) is None:
        if process.poll() is not None:
            raise SystemExit("Snakemake ended before a validation ran")
        time.sleep(1)
    node = f"nodename={job[1]}"
    output("scontrol", "update", node, "state=down", "reason=benchmark")
    time.sleep(DOWN_SECONDS)
    # refused where nodes that answer return to service by themselves
    subprocess.run(["scontrol", "update", node, "state=resume"], capture_output=True)
    return job


def reports(folder: Path) -> list[str]:
    """Channels with a report of their training and of each seed."""
    return [
        f"{d}/{p}"
        for d in DETECTORS
        for p in PERIODS
        if (folder / "results" / d / p / "report" / "metrics.json").is_file()
        and (folder / "results" / d / p / "seeds.html").is_file()
    ]


def require(fact: bool, words: str) -> None:
    print(f"{'yes' if fact else 'NO '}  {words}", flush=True)
    if not fact:
        raise SystemExit(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--status-command", default="sacct", choices=["sacct", "squeue"])
    given = parser.parse_args()
    if shutil.which("sbatch") is None:
        raise SystemExit("no SLURM here: no command sbatch")
    folder: Path = given.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    damaged = prepare(folder)
    for name in ("results", ".snakemake"):
        shutil.rmtree(folder / name, ignore_errors=True)
    whole = damaged.with_name("whole.lh5")
    if not whole.exists():
        damaged.rename(whole)
    damaged.write_text("no pulses")
    begin = time.monotonic()
    process = start(folder, "first.log", given.status_command)
    job, node = set_down_and_up(process)
    code = process.wait()
    printed = (folder / "first.log").read_text()
    minutes = (time.monotonic() - begin) / 60
    print(f"first run: {minutes:.1f} min; validation {job} ran when {node} went down")
    channels = len(DETECTORS) * len(PERIODS)
    require(code != 0, "a channel that fails fails the run")
    killed = sum("exceeded memory limit" in log.read_text() for log in folder.glob(LOGS))
    killed += printed.count("OUT_OF_MEMORY")
    require(killed > 0, f"trainings are killed for memory, and tried again: {killed}")
    require(len(reports(folder)) == channels - 1, "all other channels have their reports")

    shutil.copy(whole, damaged)
    begin = time.monotonic()
    code = start(folder, "second.log", given.status_command).wait()
    print(f"second run: {(time.monotonic() - begin) / 60:.1f} min")
    require(code == 0, "with the file mended the run ends well")
    require(len(reports(folder)) == channels, "every channel has its reports")
    page = (folder / "results" / "index.html").read_text()
    require(f"{channels} of {channels} reports" in page, "the page shows all of them")
    code = start(folder, "third.log", given.status_command).wait()
    nothing = "Nothing to be done" in (folder / "third.log").read_text()
    require(code == 0 and nothing, "then nothing is to be done")


if __name__ == "__main__":
    main()
