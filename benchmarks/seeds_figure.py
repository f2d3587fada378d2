"""Draw what ``benchmarks/seeds.py`` found: scores against pulses and width, and of each seed.

Run with ``python benchmarks/seeds_figure.py scores.png --pulses FOLDER ... --width FOLDER ...
--seeds FOLDER``.  Scores are divided by their ceilings; points are means of the seeds of a
folder, bars their range.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter, ScalarFormatter

SCORES = ("current_amplitude", "drift_time", "tail_slope")
COLOURS = dict(zip(SCORES, ("#0072b2", "#d55e00", "#009e73"), strict=True))
PEAKS = ("SEP", "DEP")
MARKS = {"cpunet": ("o", "-"), "fast": ("s", ":")}
APART = 0.045  # of the scores at one place, in logarithms

Runs = list[dict[str, Any]]


def runs_of(folder: Path) -> Runs:
    """Scores of all seeds in a folder."""
    return [json.loads(file.read_text()) for file in sorted(folder.glob("seed-*.json"))]


def against(axes: Axes, peak: str, folders: list[Path], name: str) -> None:
    """Draw the scores of a peak against a number of the runs."""
    places = set()
    for recipe, (mark, line) in MARKS.items():
        runs = [runs_of(folder) for folder in folders]
        runs = sorted((r for r in runs if r[0]["recipe"] == recipe), key=lambda r: r[0][name])
        for i, score in enumerate(SCORES if runs else ()):
            values = [[one[f"{peak} {score} / ceiling"] for one in of] for of in runs]
            middle = np.array([np.mean(v) for v in values])
            bars = np.abs(np.array([[min(v), max(v)] for v in values]).T - middle)
            place = np.array([of[0][name] for of in runs]) * np.exp(APART * (i - 1))
            style = {"fmt": mark + line, "mfc": "white" if line == ":" else None}
            axes.errorbar(place, middle, bars, color=COLOURS[score], ms=5, lw=1, **style)
            places |= {of[0][name] for of in runs}
    axes.set_xscale("log")
    axes.set_xticks(sorted(places))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())


def of_each_seed(axes: Axes, peak: str, folder: Path) -> None:
    """Draw the distribution of the scores of a peak over the seeds of a folder."""
    runs = runs_of(folder)
    for i, score in enumerate(SCORES):
        values = np.array([one[f"{peak} {score} / ceiling"] for one in runs])
        beside = np.linspace(-0.25, 0.25, len(values))
        axes.plot(i + beside, values, "o", color=COLOURS[score], ms=4, alpha=0.7)
        axes.hlines(np.median(values), i - 0.35, i + 0.35, color=COLOURS[score], lw=2)
    axes.set_xticks(range(len(SCORES)), [score.replace("_", "\n") for score in SCORES])
    axes.set_xlabel(f"each of {len(runs)} seeds")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    for name in ("pulses", "width"):
        parser.add_argument(f"--{name}", type=Path, nargs="+", required=True)
    parser.add_argument("--seeds", type=Path, required=True)
    given = parser.parse_args()
    figure, panels = plt.subplots(
        2, 3, figsize=(9, 5.2), sharey=True, sharex="col", layout="constrained"
    )
    for peak, (of_pulses, of_width, of_seeds) in zip(PEAKS, panels, strict=True):
        against(of_pulses, peak, given.pulses, "pulses")
        against(of_width, peak, given.width, "width")
        of_each_seed(of_seeds, peak, given.seeds)
        of_pulses.set_ylabel(f"{peak}: IoU / ceiling")
    for axes in panels.flat:
        axes.axhline(1, color="0.6", lw=0.8, zorder=0)
        axes.label_outer()
    panels[1, 0].set_xlabel("measured full-energy pulses")
    panels[1, 1].set_xlabel("width of the U-Net")
    handles = [
        plt.Line2D([], [], color=c, label=s.replace("_", " ")) for s, c in COLOURS.items()
    ]
    for recipe, (mark, line) in MARKS.items():
        style = {"mfc": "white" if line == ":" else None, "label": recipe}
        handles.append(plt.Line2D([], [], color="0.3", marker=mark, ls=line, **style))
    figure.legend(
        handles=handles, loc="outside upper center", ncols=len(handles), frameon=False
    )
    figure.savefig(given.out, dpi=130)


if __name__ == "__main__":
    main()
