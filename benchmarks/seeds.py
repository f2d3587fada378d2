"""Train a recipe on one stand with many seeds, one file of scores each; can be resumed.

Run with ``python benchmarks/seeds.py STAND FOLDER --recipe fast --seeds 20``; a stand is a
folder of ``cpunet stand``, or any with sim.lh5, data.lh5 and perhaps truth.npz.  Seeds whose
file is in FOLDER are not trained again.  With ``--sim`` the simulated pulses are those of
another stand.  A seed has failed if a score is below 0.9 of the median.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.outputs import written_aside
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.training.train import train
from cpunet.validation.evaluation import evaluate

FAILED = 0.9
PEAKS = ("SEP", "DEP")


def one_seed(
    sim: Path, stand: Path, recipe: str, overrides: list[str], seed: int
) -> dict[str, Any]:
    """Scores, also over their ceilings, AUC and edge RMSE of one training, and its cost."""
    files = PulseFile(sim / "sim.lh5"), PulseFile(stand / "data.lh5")
    truth = stand / "truth.npz"
    with tempfile.TemporaryDirectory() as folder:
        before = time.process_time()
        how = {"recipe": load_recipe(recipe, overrides), "seed": seed}
        run = train(*files, Path(folder) / "run", **how)
        cpu = time.process_time() - before
        metrics = evaluate(
            run,
            *files,
            truth=truth if truth.exists() and sim == stand else None,
            baselines=False,
            seed=seed,
        ).metrics
    found: dict[str, Any] = {"seed": seed, "seconds": run.seconds, "cpu": cpu}
    for peak in PEAKS:
        scores = metrics["peaks"][peak]
        for name, compared in scores["parameters"].items():
            iou = compared["iou"]
            found[f"{peak} {name}"] = iou["ren"]
            found[f"{peak} {name} / ceiling"] = iou["ren"] / iou["ceiling"]
        found[f"{peak} AUC"] = scores["two_sample"]["ren"]["auc"]
        if "paired" in scores:
            found[f"{peak} edge RMSE"] = scores["paired"]["ren"]["edge_rmse"]
    return found


def summary(runs: list[dict[str, Any]]) -> str:
    """Median, spread and failures of each number."""
    lines = [f"{'':<36}{'median':>10}{'lowest':>10}{'highest':>10}{'failed':>8}"]
    for name in runs[0]:
        if name == "seed":
            continue
        values = np.array([run.get(name, np.nan) for run in runs], float)
        middle = np.median(values)
        score = not name.endswith(("seconds", "cpu", "AUC", "RMSE"))
        failed = str(int((~(values >= FAILED * middle)).sum())) if score else ""
        lines.append(
            f"{name:<36}{middle:>10.4g}{values.min():>10.4g}{values.max():>10.4g}{failed:>8}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stand", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sim", type=Path)
    parser.add_argument("--recipe", default="fast")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    files = [given.folder / f"seed-{seed}.json" for seed in range(given.seeds)]
    for seed, file in enumerate(files):
        if file.exists():
            continue
        sim = given.sim or given.stand
        found = one_seed(sim, given.stand, given.recipe, given.overrides, seed)
        with written_aside(file) as aside:
            aside.write_text(json.dumps(found, indent=1) + "\n")
        print(f"seed {seed}: {found['seconds']:.0f} s", flush=True)
    print(f"{given.recipe} on {given.stand.name}, {given.seeds} seeds")
    print(summary([json.loads(file.read_text()) for file in files]))


if __name__ == "__main__":
    main()
