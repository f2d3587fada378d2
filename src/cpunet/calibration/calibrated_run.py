"""Results of a calibration: a run with its physics, the plan of one, and their figures."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

from cpunet.calibration.nuisances import titled
from cpunet.errors import CpunetError
from cpunet.outputs import FolderKind, folder_written_aside
from cpunet.plotting import COLOURS, styled
from cpunet.settings import read_json, read_settings
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.tables import text_table
from cpunet.training.run import Run

if TYPE_CHECKING:
    from pandas import DataFrame

CALIBRATION, SIM = "calibration.json", "sim.lh5"
DETECTOR, SETTINGS = "detector.yaml", "settings.yaml"
DPI = 110
PLAN = FolderKind(
    name="plan",
    command="cpunet calibrate --plan",
    own=r"plan\.json|plan\.png",
)


class Calibration(Run):
    """A run whose simulation was fitted together with the readout.

    Parameters
    ----------
    content
        Content of ``calibration.json``.
    """

    content: dict[str, Any] = Field({}, exclude=True, repr=False)

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Open the folder of a calibration.

        Raises
        ------
        CpunetError
            If the folder is not a calibrated run.
        """
        run, path = super().load(folder), Path(folder) / CALIBRATION
        if not path.is_file():
            raise CpunetError(
                f"{folder}: no calibrated run (no {CALIBRATION}); open it with "
                "cpunet.Run.load, or calibrate"
            )
        content = read_json(path, "calibrate again")
        return run.model_copy(update={"content": content})

    @cached_property
    def physics(self) -> DataFrame:
        """A row per free parameter: its value, error, simulated value, prior and others."""
        from pandas import DataFrame

        rows = {
            name: {k: v for k, v in told.items() if k != "prior"}
            | {"prior": told["prior"]["value"], "prior_error": told["prior"]["error"]}
            for name, told in self.content["parameters"].items()
        }
        return DataFrame.from_dict(rows, orient="index")

    @property
    def simulation(self) -> Path:
        """File of all events, simulated again with the calibrated physics."""
        return self._folder / SIM

    @cached_property
    def detector(self) -> Detector:
        """The calibrated detector."""
        return read_detector(str(self._folder / DETECTOR))

    @cached_property
    def settings(self) -> SimulationSettings:
        """The calibrated settings of the simulation."""
        return read_settings(SimulationSettings, self._folder / SETTINGS)

    @property
    def _folder(self) -> Path:
        assert self.folder is not None  # a calibration always has one
        return self.folder

    @property
    def figures(self) -> dict[str, Figure]:
        """``pulls``; ``profiles`` and ``directions``, if any parameter was free."""
        return calibration_figures(self.content)

    @property
    def alternatives(self) -> DataFrame:
        """Physics that explain the data about as well, the calibrated ones first.

        Values of what is free in any of them, the rise of chi-square, and the medians of
        current amplitude and drift time (ns) that they predict for energies that were not used.
        Empty if there are none.
        """
        from pandas import DataFrame

        return DataFrame(self.content.get("alternatives", ()))

    def __str__(self) -> str:
        content = self.content
        chi, fixed = content["chi_square"], content["fixed"]
        before, after = (chi[key] / chi["moments"] for key in ("before", "after"))
        lines = [
            f"{titled(name)} {shown} (simulated with {told['simulated']:.5g}; "
            f"± {told['error_all']:.2g} if all physics were free)"
            for (name, shown), told in zip(
                self._shown().items(), content["parameters"].values(), strict=True
            )
        ] or ["no parameter of the physics is determined better than it was known"]
        lines += [
            f"only together: {titled(pair['words'], units=False)} = {pair['value']:.2f} ± "
            f"{pair['error']:.2g} (errors of the priors)"
            for pair in content["together"]
        ]
        if fixed:
            falls = ", ".join(
                f"{titled(name)} (± {told['error_if_free']:.2g} if free, chi-square would fall "
                f"by {told['chi_square_would_fall_by']:.1f})"
                for name, told in fixed.items()
            )
            lines.append(f"left as simulated: {falls}")
        lines.append(f"chi-square per function {before:.2f} before, {after:.2f} after")
        if len(others := self.alternatives):
            rows = [[titled(n), *(f"{v:.5g}" for v in others[n])] for n in others]
            lines.append(text_table(["alternatives", "calibrated", *others.index[1:]], rows))
        return "\n".join([*lines, str(self.folder)])

    def _shown(self) -> dict[str, str]:
        """Each value with its error, or why there is none to tell."""
        pairs = {name for pair in self.content["together"] for name in pair["components"]}
        found = {}
        for name, told in self.content["parameters"].items():
            value = f"{told['value']:.5g} ± {told['error']:.2g}"
            if told["doubt"]:
                value = f"unreliable value: {told['value']:.5g} makes up for something else"
            elif name in pairs:
                value = "known only together with another"
            found[name] = value
        return found

    def _repr_html_(self) -> str:
        from cpunet.html_pages import part

        rows = [
            [titled(name), shown, f"{self.content['parameters'][name]['simulated']:.5g}"]
            for name, shown in self._shown().items()
        ]
        head = ["physics", "calibrated", "as simulated"]
        shown = part(
            "object", "", head=head, rows=rows, lines=map(titled, self.content["notes"])
        )
        return shown + super()._repr_html_()


@dataclass(frozen=True, eq=False, repr=False)
class Plan:
    """What pulses know of the physics before any fit: ``cpunet.calibrate(..., plan=True)``.

    Parameters
    ----------
    content
        ``errors`` of each parameter by number of pulses, alone and with all parameters free;
        ``directions`` by number of pulses.
    """

    content: dict[str, Any]

    @property
    def errors(self) -> DataFrame:
        """Expected errors: a row per parameter and kind, a column per number of pulses."""
        from pandas import DataFrame

        rows = {
            (name, kind): told[kind]
            for name, told in self.content["errors"].items()
            for kind in ("alone", "all_free")
        }
        return DataFrame.from_dict(rows, orient="index")

    def plot(self) -> Figure:
        """Draw the directions with a middling number of pulses."""
        return directions_figure(self.content["directions"][self._middle])

    def save(self, folder: str | Path, force: bool = False) -> None:
        """Write ``plan.json`` and ``plan.png``.

        Raises
        ------
        CpunetError
            If the folder exists and `force` is off, or is no plan.
        """
        with folder_written_aside(Path(folder), PLAN, force=force) as aside:
            (aside / "plan.json").write_text(json.dumps(self.content, indent=1) + "\n")
            self.plot().savefig(aside / "plan.png", dpi=DPI)

    def __str__(self) -> str:
        counts = [f"N={n}" for n in self.content["pulses"]]
        tables = []
        for kind, title in (("alone", "error of one alone"), ("all_free", "with all free")):
            rows = [
                [titled(name), *(f"{e:.3g}" for e in (told["prior"], *told[kind].values()))]
                for name, told in self.content["errors"].items()
            ]
            tables.append(text_table([title, "prior", *counts], rows))
        directions = [
            f"{d['error']:8.3f}  {titled(d['words'], units=False)}"
            for d in self.content["directions"][self._middle]
        ]
        unit = "error in units of the prior:"
        about = (
            f"eigenvectors of the covariance with {self._middle} pulses of each side, {unit}"
        )
        return "\n".join([*tables, about, *directions])

    def __repr__(self) -> str:
        return f"<Plan of {self.content['detector']}: {', '.join(self.content['errors'])}>"

    @property
    def _middle(self) -> str:
        pulses = self.content["pulses"]
        return str(pulses[len(pulses) // 2])


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
    """Pulls of all functions before and after the calibration.

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
    broken = [re.sub(r" (?=in slices)|(?<=current) ", "\n", name) for name in names]
    panel.set_xticks(middles, broken, fontsize=8)
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
    """Group to which a function belongs."""
    plain = name.split(": ")[-1]
    if plain.startswith("component") and "amplitude" in plain:
        return "components with current amplitude"
    for group in ("samples", "drift time"):
        if plain.startswith(group):
            return group
    kind = "current amplitude" if plain.startswith("current") else "components"
    return f"{kind} in slices" if "slice" in plain else kind
