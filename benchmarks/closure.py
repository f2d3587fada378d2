"""Train recipes on stands with several seeds: medians, worst 5 % and failures of the scores.

Run with ``python benchmarks/closure.py STAND [STAND ...] --recipe fast --seeds 3``; a stand
is a folder of ``cpunet stand``, or any with sim.lh5, data.lh5 and perhaps truth.npz.  A seed
has failed if its score is below 0.9 of the median.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cpunet.errors import CpunetError
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.training.train import train
from cpunet.validation.evaluation import evaluate

FAILED = 0.9


def scores_of(
    stand: Path, recipe: str, overrides: list[str], seed: int, baselines: bool
) -> dict[str, Any]:
    """Metrics of one run, trained and scored in a temporary folder."""
    sim, data = PulseFile(stand / "sim.lh5"), PulseFile(stand / "data.lh5")
    truth = stand / "truth.npz"
    with tempfile.TemporaryDirectory() as folder:
        how = {"recipe": load_recipe(recipe, overrides), "seed": seed}
        run = train(sim, data, Path(folder) / "run", **how)
        return evaluate(
            run,
            sim,
            data,
            truth=truth if truth.exists() else None,
            baselines=baselines,
            seed=seed,
        ).metrics


def summarise(title: str, runs: list[dict[str, Any]]) -> Table:
    """IoU by peak, parameter and method over the seeds of one recipe on one stand."""
    table = Table(title=title)
    for column in ("peak", "parameter", "method", "median", "worst 5 %", "failures", "ceiling"):
        table.add_column(column, no_wrap=True)
    for peak in ("SEP", "DEP"):
        for parameter, first in runs[0]["peaks"][peak]["parameters"].items():
            compared = [run["peaks"][peak]["parameters"][parameter]["iou"] for run in runs]
            ceiling = np.median([iou["ceiling"] for iou in compared])
            for method in first["wasserstein"]:
                values = np.array([iou.get(method, np.nan) for iou in compared], float)
                middle = np.nanmedian(values)
                failures = int((~(values >= FAILED * middle)).sum())
                table.add_row(
                    peak,
                    parameter,
                    method,
                    f"{middle:.1f}",
                    f"{np.nanquantile(values, 0.05):.1f}",
                    str(failures),
                    f"{ceiling:.1f}",
                )
        for name, values in single_numbers(runs, peak).items():
            middle, high = np.median(values), np.quantile(values, 0.95)
            table.add_row(peak, name, "ren", f"{middle:.5f}", f"{high:.5f}", "", "")
    return table


def single_numbers(runs: list[dict[str, Any]], peak: str) -> dict[str, list[float]]:
    """Scores of the translation for which small is good: by name, one per seed."""
    found: dict[str, list[float]] = {}
    for run in runs:
        scores = run["peaks"][peak]
        if "auc" in scores["two_sample"].get("ren", {}):
            found.setdefault("AUC", []).append(scores["two_sample"]["ren"]["auc"])
        if "paired" in scores:
            found.setdefault("edge RMSE", []).append(scores["paired"]["ren"]["edge_rmse"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stands", nargs="+", type=Path)
    parser.add_argument("--recipe", action="append")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--no-baselines", action="store_false", dest="baselines")
    arguments = parser.parse_args()
    console = Console(width=110)  # whole rows, also into a file
    for stand in arguments.stands:
        for recipe in arguments.recipe or ["fast"]:
            runs = []
            for seed in range(arguments.seeds):
                try:
                    more = arguments.overrides, seed, arguments.baselines
                    runs.append(scores_of(stand, recipe, *more))
                except CpunetError as error:
                    console.print(f"seed {seed} failed: {error}")
            if runs:
                console.print(summarise(f"{recipe} on {stand.name}, {len(runs)} seeds", runs))


if __name__ == "__main__":
    main()
