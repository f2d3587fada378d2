"""A REN for another readout, started from a trained one: time and scores against a fresh start.

Run with ``python benchmarks/transfer.py KNOWN STAND``: folders of ``cpunet stand`` with
different readouts.  The training on the second starts from the REN of the first, and uses only
``--pulses`` measured pulses of the training peak.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes import load_recipe
from cpunet.training.train import train
from cpunet.validation.evaluation import evaluate


def few_of(data: PulseFile, pulses: int, folder: Path) -> PulseFile:
    """A file with that many traces of the training peak."""
    recipe = load_recipe("fast").at(16)
    select = parse_selection("FEP", recipe.peaks).select
    kept: list[Pulses] = []
    for block in data.open().blocks():
        kept.append(block[np.flatnonzero(select(block.energy_kev))])
        if sum(map(len, kept)) >= pulses:
            break
    few = Pulses.of(
        np.concatenate([part.waveforms for part in kept])[:pulses],
        dt_ns=kept[0].dt_ns,
        energy_kev=np.concatenate([part.energy_kev for part in kept])[:pulses],
    )
    path = folder / "few.lh5"
    with PulseWriter(path, table="geds/raw") as writer:
        writer.append(few)
    return PulseFile(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("known", type=Path)
    parser.add_argument("stand", type=Path)
    parser.add_argument("--pulses", type=int, default=500)
    arguments = parser.parse_args()
    sim, data = (PulseFile(arguments.stand / f"{side}.lh5") for side in ("sim", "data"))
    rows: dict[str, tuple[float, dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known = folder / "known"
        sides = [PulseFile(arguments.known / f"{side}.lh5") for side in ("sim", "data")]
        train(sides[0], sides[1], known, recipe=load_recipe("fast"), device="cpu")
        few = few_of(data, arguments.pulses, folder)
        for title, start, measured in (
            ("fresh, all pulses", None, data),
            (f"fresh, {arguments.pulses} pulses", None, few),
            (f"from the other, {arguments.pulses} pulses", known, few),
        ):
            run = folder / title.replace(" ", "_").replace(",", "")
            recipe = load_recipe("fast").at(16)
            made = train(sim, measured, run, recipe=recipe, init=start, device="cpu")
            truth = arguments.stand / "truth.npz"
            scored = evaluate(made, sim, data, truth=truth, baselines=False)
            rows[title] = (made.seconds, scored.metrics)
    show(rows)


def show(rows: dict[str, tuple[float, dict[str, Any]]]) -> None:
    """Seconds and scores of each training."""
    table = Table()
    for column in (
        "training",
        "seconds",
        "peak",
        "I_max",
        "T_drift",
        "tail",
        "AUC",
        "edge RMSE",
    ):
        table.add_column(column, no_wrap=True)
    for title, (seconds, metrics) in rows.items():
        for peak in ("SEP", "DEP"):
            scores = metrics["peaks"][peak]
            iou = [f"{p['iou']['ren']:.1f}" for p in scores["parameters"].values()]
            auc = f"{scores['two_sample']['ren']['auc']:.2f}"
            edge = f"{scores['paired']['ren']['edge_rmse']:.5f}"
            table.add_row(title, f"{seconds:.0f}", peak, *iou, auc, edge)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
