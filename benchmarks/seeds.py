"""Train a recipe on one stand with many seeds, one file of scores each; can be resumed.

Run with ``python benchmarks/seeds.py STAND FOLDER --recipe fast --seeds 20``; a stand is a
folder of ``cpunet stand``, or any with sim.lh5, data.lh5 and perhaps truth.npz.  Seeds whose
file is in FOLDER are not trained again.  With ``--sim`` the simulated pulses are those of
another stand.  A seed has failed if a score is below 0.9 of the median.

Scores of a run scatter with the noise that is drawn for its translations, by 1 to 3 points with
a thousand pulses.  With ``--draws 5`` they are means over so many draws, and what differs
between seeds is the training.
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
from cpunet.training.run import Run
from cpunet.training.train import train
from cpunet.validation.comparisons import Missing
from cpunet.validation.metrics import Metrics
from cpunet.validation.validate import evaluate

FAILED = 0.9
FAR = 1000  # between the seeds of draws of noise
PEAKS = ("SEP", "DEP")
ABOUT = ("recipe", "pulses", "width", "seed")


def one_seed(
    sim: Path, stand: Path, recipe: str, overrides: list[str], peak: str, seed: int, draws: int
) -> dict[str, Any]:
    """Scores, also over their ceilings, AUC and edge RMSE of one training, and its cost."""
    files = PulseFile(sim / "sim.lh5"), PulseFile(stand / "data.lh5")
    truth = stand / "truth.npz"
    with tempfile.TemporaryDirectory() as folder:
        before = time.process_time()
        settings = load_recipe(recipe, overrides)
        run = train(*files, Path(folder) / "run", recipe=settings, peak=peak, seed=seed)
        assert isinstance(run, Run)
        cpu = time.process_time() - before
        known = truth if truth.exists() and sim == stand else None
        drawn = [
            evaluate(run, *files, truth=known, baselines=False, seed=seed + FAR * draw).metrics
            for draw in range(draws)
        ]
    draws_of = [numbers(metrics) for metrics in drawn]
    means = {name: float(np.mean([of[name] for of in draws_of])) for name in draws_of[0]}
    width = getattr(run.recipe.generator, "width", None)
    about = dict(zip(ABOUT, (recipe, run.data.used, width, seed), strict=True))
    return about | {"seconds": run.seconds, "cpu": cpu} | means


def numbers(metrics: Metrics) -> dict[str, float]:
    """Scores by peak and name."""
    values: dict[str, float | None] = {}
    for peak in PEAKS:
        scores = metrics.peaks[peak]
        for name, compared in scores.parameters.items():
            iou = compared.iou
            values[f"{peak} {name}"] = iou["ren"]
            ceiling = iou["ceiling"] or np.nan
            for method, of in (("ren", ""), ("truth", " of truth")):
                if method in iou:
                    values[f"{peak} {name} / ceiling{of}"] = (iou[method] or 0.0) / ceiling
        tested = scores.two_sample["ren"]
        values[f"{peak} AUC"] = None if isinstance(tested, Missing) else tested.auc
        if scores.paired:
            values[f"{peak} edge RMSE"] = scores.paired["ren"].edge_rmse
    return {name: np.nan if value is None else value for name, value in values.items()}


def summary(runs: list[dict[str, Any]]) -> str:
    """Median, spread and failures of each number."""
    lines = [f"{'':<44}{'median':>10}{'lowest':>10}{'highest':>10}{'failed':>8}"]
    for name in list(runs[0])[len(ABOUT) :]:
        values = np.array([run.get(name, np.nan) for run in runs], float)
        middle = np.median(values)
        score = not name.endswith(("seconds", "cpu", "AUC", "RMSE"))
        failed = str(int((~(values >= FAILED * middle)).sum())) if score else ""
        lines.append(
            f"{name:<44}{middle:>10.4g}{values.min():>10.4g}{values.max():>10.4g}{failed:>8}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stand", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sim", type=Path)
    parser.add_argument("--recipe", default="fast")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--peak", default="FEP", help="pulses of the training")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--draws", type=int, default=1)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    files = [given.folder / f"seed-{seed}.json" for seed in range(given.seeds)]
    for seed, file in enumerate(files):
        if file.exists():
            continue
        sim = given.sim or given.stand
        how = given.recipe, given.overrides, given.peak
        values = one_seed(sim, given.stand, *how, seed, given.draws)
        with written_aside(file) as aside:
            aside.write_text(json.dumps(values, indent=1) + "\n")
        print(f"seed {seed}: {values['seconds']:.0f} s", flush=True)
    print(f"{given.recipe} on {given.stand.name}, {given.seeds} seeds")
    print(summary([json.loads(file.read_text()) for file in files]))


if __name__ == "__main__":
    main()
