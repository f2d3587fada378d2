"""Figures of a calibration: profiles, pulls by moment, directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cpunet.calibration.nuisances import titled
from cpunet.plotting import COLOURS, styled

BEFORE, AFTER = COLOURS["raw"], COLOURS["ren"]
# Columns of panels.
COLUMNS = 3
# Pulls up to which the axis is linear.
LINEAR = 3.0


def calibration_figures(content: Mapping[str, Any]) -> dict[str, Figure]:
    """``pulls``; ``profiles`` and ``directions``, if any parameter was free.

    Parameters
    ----------
    content
        Content of ``calibration.json``.
    """
    found = {"pulls": pulls_figure(content)}
    if content["profiles"]:
        found["profiles"] = profiles_figure(content)
    if content["directions"]:
        found["directions"] = directions_figure(content["directions"])
    return found


@styled
def profiles_figure(content: Mapping[str, Any]) -> Figure:
    """Profile chi-square of each free parameter, one panel each.

    Parameters
    ----------
    content
        Content of ``calibration.json``, with at least one free parameter.
    """
    profiles = content["profiles"]
    rows = -(-len(profiles) // COLUMNS)
    columns = min(COLUMNS, len(profiles))
    figure = Figure(figsize=(0.6 + 3.1 * columns, 0.4 + 2.5 * rows))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[len(profiles) :]:
        panel.set_axis_off()
    for panel, (name, profile) in zip(panels, profiles.items(), strict=False):
        values, cost = np.array(profile["value"]), np.array(profile["chi_square"])
        told = content["parameters"][name]
        grid = np.linspace(values.min(), values.max(), 200)
        parabola = ((grid - told["value"]) / told["error"]) ** 2
        panel.plot(grid, parabola, color="0.6", label="error quoted")
        panel.plot(values, cost - cost.min(), "o", color=AFTER, label="profile")
        if values.min() <= told["simulated"] <= values.max():
            panel.axvline(told["simulated"], color=BEFORE, ls="--", label="as simulated")
        panel.set_xlabel(titled(name))
        panel.set_ylim(-0.5, 12)
        panel.set_ylabel("Δχ²")
    panels[0].legend()
    return figure


@styled
def pulls_figure(content: Mapping[str, Any]) -> Figure:
    """Pulls of all moments before and after the calibration.

    Parameters
    ----------
    content
        Content of ``calibration.json``.
    """
    pulls = content["pulls"]
    groups = [_group(name) for name in pulls["names"]]
    names = list(dict.fromkeys(groups))
    figure = Figure(figsize=(9.5, 3.6))
    panel = figure.subplots()
    x = np.arange(len(groups))
    for key, colour, label in (
        ("before", BEFORE, "as simulated, chain alone"),
        ("after", AFTER, "calibrated"),
    ):
        panel.plot(x, pulls[key], ".", ms=4, color=colour, label=label)
    panel.set_yscale("symlog", linthresh=LINEAR)
    panel.axhspan(-2, 2, color="0.9", zorder=0)
    starts = [groups.index(name) for name in names]
    for start in starts[1:]:
        panel.axvline(start - 0.5, color="0.8", lw=0.8)
    ends = [*starts[1:], len(groups)]
    middles = [0.5 * (a + b - 1) for a, b in zip(starts, ends, strict=True)]
    panel.set_xticks(middles, [_wrapped(name) for name in names], fontsize=8)
    panel.grid(axis="x", visible=False)
    panel.set_ylabel("deviation [standard deviations]\n(symlog scale)")
    panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return figure


@styled
def directions_figure(directions: Sequence[Mapping[str, Any]]) -> Figure:
    """Principal axes of the information matrix as a colour table, with the error of each.

    Parameters
    ----------
    directions
        Directions from ``calibration.json`` or ``plan.json``.
    """
    names = list(directions[0]["components"])
    matrix = np.array([[d["components"][name] for name in names] for d in directions])
    errors = np.array([d["error"] for d in directions])
    size = 0.34 * len(names)
    figure = Figure(figsize=(5.6 + size, 2.0 + size))
    left, right = figure.subplots(
        1, 2, sharey=True, gridspec_kw={"width_ratios": [len(names), 5]}
    )
    left.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    titles = [titled(name, units=False) for name in names]
    left.set_xticks(range(len(names)), titles, rotation=60, ha="right", fontsize=8)
    left.set_yticks(range(len(errors)), [str(i + 1) for i in range(len(errors))])
    left.set_ylabel("direction, best known first")
    left.grid(visible=False)
    right.barh(range(len(errors)), errors, color=np.where(errors < 0.5, AFTER, "0.75"))
    right.set_xscale("log")
    right.set_xlim(min(1e-3, 0.5 * errors.min()), 1.2)
    right.axvline(1, color="0.5", lw=0.8)
    right.set_xlabel("error in units of the prior")
    return figure


def _group(name: str) -> str:
    """Group to which a moment belongs."""
    plain = name.split(": ")[-1]
    if plain.endswith("squared"):
        return "squares"
    for group in ("samples", "drift time"):
        if plain.startswith(group):
            return group
    kind = "current amplitude" if plain.startswith("current") else "components"
    return f"{kind} in slices" if "slice" in plain else kind


def _wrapped(name: str) -> str:
    return name.replace(" in slices", "\nin slices").replace("current ", "current\n")
