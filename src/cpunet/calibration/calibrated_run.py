"""Results of a calibration: a run with its physics, a plan, and their figures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field, ValidationError

from cpunet.calibration.nuisances import titled
from cpunet.errors import CpunetError
from cpunet.outputs import FolderKind, folder_written_aside
from cpunet.plotting import COLOURS, styled
from cpunet.pulses.loading import InfoPart
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
PLAN = FolderKind("plan", "cpunet calibrate --plan", r"plan\.(json|png)")
_BY_LOAD: Any = {"default": None, "exclude": True, "repr": False}
MIDDLE = "4000"  # pulses for which a plan shows directions
SHOWN = 0.25  # least component of a direction that is shown


class Direction(InfoPart):
    r"""A combination of parameters, and how well the pulses determine it.

    Parameters
    ----------
    components
        Components by name, in units of the priors.  Their squares add up to 1.
    error
        Standard deviation given prior and data, in units of the prior:
        :math:`1/\sqrt{1 + \lambda}` with the eigenvalue :math:`\lambda` of the scaled
        information.  It is 1 if the data contain no information.
    value
        Its value in errors of the priors, if it was fitted.
    """

    components: dict[str, float]
    error: float
    value: float | None = None

    @property
    def words(self) -> str:
        """The larger components as a sum."""
        parts = sorted(self.components.items(), key=lambda part: -abs(part[1]))
        shown = [(n, c) for n, c in parts if abs(c) >= SHOWN]
        text = " ".join(f"{'+' if c > 0 else '−'} {abs(c):.2f} {n}" for n, c in shown)
        return text.removeprefix("+ ")


class FreeParameter(InfoPart):
    """A free parameter of the physics, in its unit.

    Parameters
    ----------
    value, error
        Value, and its error with the fixed parameters as simulated.
    error_all
        Error with all parameters considered free.
    simulated
        Value as simulated.
    doubt
        Why the value is unreliable, or None.
    prior, prior_error, source
        Prior, and where it is from.
    """

    value: float
    error: float
    error_all: float
    simulated: float
    doubt: str | None
    prior: float
    prior_error: float
    source: str


class FixedParameter(InfoPart):
    """A parameter that stays as simulated, and what would be if it were free."""

    value: float
    chi_square_would_fall_by: float
    error_if_free: float


class ChiSquare(InfoPart):
    """Chi-square of the compared functions.

    Parameters
    ----------
    before, after
        With the physics as simulated, and calibrated.
    moments
        Number of functions.
    expected, spread
        Mean and standard deviation if simulation and data agree.
    errors_scaled_by
        Factor of the errors of the parameters, from imperfect agreement.
    """

    before: float
    after: float
    moments: int
    expected: float
    spread: float
    errors_scaled_by: float


class CalibratedPhysics(InfoPart):
    """The calibrated physics: content of ``calibration.json``.

    Parameters
    ----------
    parameters, fixed
        By name.
    together
        Pairs of free parameters of which only a combination is determined.
    others
        A line on each of the other physics that explain the pulses about as well.
    directions
        Eigenvectors of the covariance of all physics, best determined first.
    chi_square
        Of all that is compared.
    covariance
        Of the coordinates of the free parameters, in their order.
    groups, pulls_before, pulls_after
        How many functions each group has, and their deviations in standard deviations.
    rounds, settled
        Number of rounds, and whether the physics was unchanged in the last.
    notes
        Remarks on the result.
    """

    parameters: dict[str, FreeParameter]
    fixed: dict[str, FixedParameter]
    together: list[Direction]
    others: list[str]
    directions: list[Direction]
    chi_square: ChiSquare
    covariance: list[list[float]]
    groups: dict[str, int]
    pulls_before: list[float]
    pulls_after: list[float]
    rounds: int
    settled: bool
    notes: list[str]

    @property
    def figures(self) -> dict[str, Figure]:
        """``pulls`` and ``directions``."""
        return {"pulls": pulls_figure(self), "directions": directions_figure(self.directions)}

    @property
    def comment(self) -> str:
        """Comment on unreliable values, for the files of the physics."""
        doubts = ((name, of.doubt) for name, of in self.parameters.items() if of.doubt)
        text = "unreliable value, makes up for something else"
        return "".join(f"# {name}: {text} ({doubt})\n" for name, doubt in doubts)

    @property
    def shown(self) -> dict[str, str]:
        """Each value with its error, or why none is given."""
        texts = {n: f"{of.value:.5g} ± {of.error:.2g}" for n, of in self.parameters.items()}
        for pair in self.together:
            texts |= dict.fromkeys(pair.components, "determined only together with another")
        for name, of in self.parameters.items():
            if of.doubt:
                texts[name] = f"unreliable value: {of.value:.5g} makes up for something else"
        return texts

    def __str__(self) -> str:
        lines = [
            f"{titled(name)} {text} (simulated with {self.parameters[name].simulated:.5g}; "
            f"± {self.parameters[name].error_all:.2g} if all physics were free)"
            for name, text in self.shown.items()
        ] or ["no parameter of the physics is determined better than by its prior"]
        lines += [
            f"only together: {titled(pair.words, units=False)} = {pair.value:.2f} ± "
            f"{pair.error:.2g} (errors of the priors)"
            for pair in self.together
        ]
        falls = [
            f"{titled(name)} (± {fixed.error_if_free:.2g} if free, chi-square would fall by "
            f"{fixed.chi_square_would_fall_by:.1f})"
            for name, fixed in self.fixed.items()
        ]
        lines += [f"left as simulated: {', '.join(falls)}"] if falls else []
        chi = self.chi_square
        before, after = chi.before / chi.moments, chi.after / chi.moments
        lines.append(f"chi-square per function {before:.2f} before, {after:.2f} after")
        lines += [f"explains the pulses as well: {titled(text)}" for text in self.others]
        return "\n".join(lines)


class Calibration(Run):
    """A run whose simulation was fitted together with the readout.

    Parameters
    ----------
    result
        The calibrated physics.
    """

    folder: Path = Field(**_BY_LOAD)
    result: CalibratedPhysics = Field(**_BY_LOAD)

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
        try:
            result = CalibratedPhysics.model_validate(read_json(path, "calibrate again"))
        except ValidationError as error:
            where = ".".join(map(str, error.errors()[0]["loc"]))
            raise CpunetError(f"{path}: damaged ({where}); calibrate again") from error
        return run.model_copy(update={"result": result})

    @cached_property
    def physics(self) -> DataFrame:
        """A row per free parameter: its value, error, simulated value, prior and others."""
        from pandas import DataFrame

        rows = self.result.model_dump()["parameters"]
        return DataFrame.from_dict(rows, orient="index")

    @property
    def simulation(self) -> Path:
        """File of all events, simulated again with the calibrated physics."""
        return self.folder / SIM

    @cached_property
    def detector(self) -> Detector:
        """The calibrated detector."""
        return read_detector(str(self.folder / DETECTOR))

    @cached_property
    def settings(self) -> SimulationSettings:
        """The calibrated settings of the simulation."""
        return read_settings(SimulationSettings, self.folder / SETTINGS)

    @property
    def figures(self) -> dict[str, Figure]:
        """``pulls`` and ``directions``."""
        return self.result.figures

    def __str__(self) -> str:
        return f"{self.result}\n{self.folder}"

    def _repr_html_(self) -> str:
        from cpunet.html_pages import part

        shown, of = self.result.shown, self.result.parameters
        rows = [[titled(n), text, f"{of[n].simulated:.5g}"] for n, text in shown.items()]
        head, notes = ["physics", "calibrated", "as simulated"], map(titled, self.result.notes)
        return part("object", "", head=head, rows=rows, lines=notes) + super()._repr_html_()


class ExpectedErrors(InfoPart):
    """Errors of a parameter: of its prior, and by number of pulses alone and with all free."""

    simulated: float
    prior: float
    alone: dict[str, float]
    all_free: dict[str, float]


class Plan(InfoPart):
    """Expected sensitivity to the physics: ``cpunet.calibrate(..., plan=True)``.

    Parameters
    ----------
    detector
        Name of the detector.
    errors_by_name
        Expected errors by parameter.
    directions
        Eigenvectors of the covariance by number of pulses.
    """

    detector: str
    errors_by_name: dict[str, ExpectedErrors]
    directions: dict[str, list[Direction]]

    @property
    def errors(self) -> DataFrame:
        """Expected errors: a row per parameter and kind, a column per number of pulses."""
        from pandas import DataFrame

        rows: dict[tuple[str, str], dict[str, float]] = {}
        for name, of in self.errors_by_name.items():
            rows |= {(name, "alone"): of.alone, (name, "all_free"): of.all_free}
        return DataFrame.from_dict(rows, orient="index")

    def plot(self) -> Figure:
        """Draw the directions with a middling number of pulses."""
        return directions_figure(self.directions[MIDDLE])

    def save(self, folder: str | Path, force: bool = False) -> None:
        """Write ``plan.json`` and ``plan.png``.

        Raises
        ------
        CpunetError
            If the folder exists and `force` is off, or is no plan.
        """
        with folder_written_aside(Path(folder), PLAN, force=force) as aside:
            (aside / "plan.json").write_text(self.model_dump_json(indent=1) + "\n")
            self.plot().savefig(aside / "plan.png", dpi=DPI)

    def __str__(self) -> str:
        counts, lines = [f"N={n}" for n in self.directions], []
        for kind, title in (("alone", "error of each alone"), ("all_free", "with all free")):
            rows = []
            for name, of in self.errors_by_name.items():
                errors = of.prior, *getattr(of, kind).values()
                rows.append([titled(name), *(f"{error:.3g}" for error in errors)])
            lines.append(text_table([title, "prior", *counts], rows))
        title = f"eigenvectors of the covariance with {MIDDLE} pulses of each side"
        lines.append(f"{title}, error in units of the prior:")
        axes = self.directions[MIDDLE]
        lines += [f"{axis.error:8.3f}  {titled(axis.words, units=False)}" for axis in axes]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"<Plan of {self.detector}: {', '.join(self.errors_by_name)}>"


BEFORE, AFTER = COLOURS["raw"], COLOURS["ren"]
LINEAR = 3.0  # pulls up to which the axis is linear


@styled
def pulls_figure(result: CalibratedPhysics) -> Figure:
    """Pulls of all functions before and after a calibration."""
    figure = Figure(figsize=(9.5, 3.6))
    panel = figure.subplots()
    before, after = result.pulls_before, result.pulls_after
    x = np.arange(len(after))
    panel.plot(x, before, ".", ms=4, color=BEFORE, label="as simulated, chain alone")
    panel.plot(x, after, ".", ms=4, color=AFTER, label="calibrated")
    panel.set_yscale("symlog", linthresh=LINEAR)
    panel.axhspan(-2, 2, color="0.9", zorder=0)
    sizes = np.array([*result.groups.values()])
    ends = np.cumsum(sizes)
    for end in ends[:-1]:
        panel.axvline(end - 0.5, color="0.8", lw=0.8)
    middles = ends - 0.5 * (sizes + 1)
    broken = [re.sub(r" (?=in slices)|(?<=current) ", "\n", name) for name in result.groups]
    panel.set_xticks(middles, broken, fontsize=8)
    panel.grid(axis="x", visible=False)
    panel.set_ylabel("deviation [standard deviations]\n(symlog scale)")
    panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return figure


@styled
def directions_figure(directions: Sequence[Direction]) -> Figure:
    """Eigenvectors of the covariance as a colour table, with the error of each."""
    names = list(directions[0].components)
    matrix = np.array([[axis.components[name] for name in names] for axis in directions])
    errors = np.array([axis.error for axis in directions])
    size = 0.34 * len(names)
    figure = Figure(figsize=(5.6 + size, 2.0 + size))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[len(names), 5])
    left.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    titles = [titled(name, units=False) for name in names]
    left.set_xticks(range(len(names)), titles, rotation=60, ha="right", fontsize=8)
    left.set_yticks(range(len(errors)), [str(i + 1) for i in range(len(errors))])
    left.set_ylabel("eigenvector, best determined first")
    left.grid(visible=False)
    right.barh(range(len(errors)), errors, color=np.where(errors < 0.5, AFTER, "0.75"))
    right.set_xscale("log")
    right.set_xlim(min(1e-3, 0.5 * errors.min()), 1.2)
    right.axvline(1, color="0.5", lw=0.8)
    right.set_xlabel("error in units of the prior")
    return figure
