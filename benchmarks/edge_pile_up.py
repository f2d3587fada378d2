"""Efficiency and cost of finding pile-up within the rise, on datasets with known pile-up.

Two indicators are tried on measured pulses that passed the quality cuts: the distance of the
edge from the nearest translated pulse, and the second maximum of the current. The translated
pulses are the true responses, so the first cannot perform better than here. Run with
``python benchmarks/edge_pile_up.py FOLDER``, a folder of ``cpunet stand``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console

from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import align_half_maximum
from cpunet.pulses.preparation import Prepared, apply_cuts, fit_cuts, prepare
from cpunet.pulses.reading.files import open_pulses
from cpunet.recipes import load_recipe

Values = npt.NDArray[np.float64]

LINES = ("DEP", "SEP", "FEP")
BEFORE, AFTER = 80, 120  # samples about the half maximum
COMPONENTS = 30  # principal components of an edge; the remainder is compared, too
LOSSES = (0.002, 0.005, 0.01, 0.02, 0.05)  # fractions of the good pulses
PILE_UP = 2  # bit of a flag
NEAR = 3  # samples of a moving average of the current


def edges_of(windows: npt.NDArray[np.float32]) -> Values:
    """Edges around half maximum, of pulses scaled to unit height."""
    height = np.sort(windows, axis=1)[:, -20:].mean(axis=1, keepdims=True)
    aligned: Values = align_half_maximum(windows / height, BEFORE, AFTER).astype(float)
    return np.asarray(np.nan_to_num(aligned))


def distances(edges: Values, others: Values) -> Values:
    """RMS distance of each edge from the nearest of the others."""
    mean = others.mean(axis=0)
    _, _, axes = np.linalg.svd(others - mean, full_matrices=False)
    axes = axes[:COMPONENTS]
    mine, theirs = (edges - mean) @ axes.T, (others - mean) @ axes.T
    remainder = ((edges - mean) ** 2).sum(axis=1) - (mine**2).sum(axis=1)
    square = (mine**2).sum(axis=1)[:, None] - 2 * mine @ theirs.T + (theirs**2).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(square.min(axis=1) + remainder, 0) / edges.shape[1]))


def second_maxima(edges: Values) -> Values:
    """Height of the current's second maximum relative to the first; 0 if there is none."""
    current = np.diff(edges, axis=1)
    for _ in range(2):
        current = np.apply_along_axis(np.convolve, 1, current, np.ones(NEAR) / NEAR, "same")
    top = (current[:, 1:-1] > current[:, :-2]) & (current[:, 1:-1] >= current[:, 2:])
    heights = np.where(top, current[:, 1:-1], 0.0)
    largest = np.sort(heights, axis=1)[:, -2:]
    return np.asarray(largest[:, 0] / np.maximum(largest[:, 1], 1e-9))


def passed(folder: Path) -> tuple[Prepared, npt.NDArray[np.int64], dict[str, Values]]:
    """Measured pulses that pass the quality cuts, their gamma lines, and all their labels."""
    recipe = load_recipe("fast").at(16)
    known = dict(np.load(folder / "data_labels.npz"))
    raw = open_pulses(folder / "data.lh5").read()
    raw = raw[np.flatnonzero(known["label"] < len(LINES))]
    known = {name: one[known["label"] < len(LINES)] for name, one in known.items()}
    prepared = prepare(raw, recipe.preparation, "measured")
    kept = apply_cuts(prepared, fit_cuts(prepared, recipe.cuts))
    console.print(
        f"{folder}: {len(kept)} of {len(raw)} pulses pass the cuts; with pile-up "
        f"{(known['flag'][kept.index] & PILE_UP > 0).sum()} of "
        f"{(known['flag'] & PILE_UP > 0).sum()}"
    )
    known = {name: one[kept.index] for name, one in known.items()}
    return kept, known["label"], known


def translated(folder: Path) -> tuple[Values, npt.NDArray[np.int64]]:
    """Edges of the true responses to simulated pulses, and their gamma lines."""
    truth = np.load(folder / "truth.npz")
    lines = truth["label"] < len(LINES)
    records = Pulses.of(truth["response"][lines].astype(np.float32), dt_ns=16)
    config = load_recipe("fast").preparation.model_copy(update={"saturation_run": 5000})
    clean = prepare(records, config, "measured")
    return edges_of(clean.pulses.waveforms), truth["label"][lines][clean.index]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="+")
    for folder in parser.parse_args().folder:
        kept, label, known = passed(folder)
        energy = kept.pulses.energy_kev
        edges = edges_of(kept.pulses.waveforms)
        others, _ = translated(folder)
        signs = {
            "nearest": distances(edges, others) * energy,
            "second maximum": second_maxima(edges),
        }
        piled = known["flag"].astype(int) & PILE_UP > 0
        inside = piled
        if "piled_ns" in known:
            with np.errstate(invalid="ignore"):
                inside = piled & (known["piled_ns"] > -1000) & (known["piled_ns"] < 1500)
                inside &= known["piled_kev"] > 20
            console.print(f"of these within the rise and above 20 keV: {inside.sum()}")
        for name, sign in signs.items():
            for line, of_line in enumerate(LINES):
                good, bad = ~piled & (label == line), inside & (label == line)
                shares = " ".join(
                    f"{100 * (sign[bad] > np.quantile(sign[good], 1 - loss)).mean():5.0f} %"
                    for loss in LOSSES
                )
                console.print(f"{name}, {of_line} ({bad.sum()} of {good.sum()}): {shares}")
        console.print("at losses of " + ", ".join(f"{100 * loss:g} %" for loss in LOSSES))


console = Console(soft_wrap=True)

if __name__ == "__main__":
    main()
