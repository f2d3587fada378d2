"""`cpunet.train`, and the trained run that it returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from cpunet.analysis.html_pages import notebook_picture, part
from cpunet.analysis.response_figure import response_figure
from cpunet.analysis.run_figures import loss_curves
from cpunet.calls.given import File, as_input, as_recipe
from cpunet.errors import CpunetError
from cpunet.jobs.inspection.chain_description import chain_of, describe_responses
from cpunet.jobs.training.train import train_run
from cpunet.jobs.training.training_job import TrainOptions
from cpunet.recipes.network_settings import ResponseConfig
from cpunet.recipes.schema import Recipe
from cpunet.training.run_folder import read_info, read_losses, read_recipe
from cpunet.translation.translator import IREN, REN

if TYPE_CHECKING:
    from cpunet.calls.reports import Report
    from cpunet.calls.translations import Translation


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """A training run, returned by `cpunet.train` or opened with `Run.load`.

    Parameters
    ----------
    folder
        Folder of the run.
    info
        The content of its ``run.json``.
    """

    folder: Path
    info: Mapping[str, Any]

    @classmethod
    def load(cls, folder: str | Path) -> Run:
        """Open the folder of a finished run.

        Raises
        ------
        CpunetError
            If the folder is not a run.
        """
        return cls(Path(folder), read_info(Path(folder)))

    @cached_property
    def ren(self) -> REN:
        """Translator from simulated to measured-like pulses."""
        return REN.load(self.folder)

    @cached_property
    def iren(self) -> IREN:
        """Translator from measured to simulation-like pulses."""
        return IREN.load(self.folder)

    @cached_property
    def recipe(self) -> Recipe:
        """All settings of the training."""
        return read_recipe(self.folder)

    @property
    def dt_ns(self) -> float:
        """Sampling period in ns."""
        return float(self.info["dt_ns"])

    @property
    def chi_square_per_moment(self) -> float | None:
        """Fit quality of a readout chain; well above 1 if more than the readout differs."""
        fit = self.info.get("fit") or {}
        if not fit.get("moments"):
            return None
        return float(fit["chi_square"]) / float(fit["moments"])

    @cached_property
    def losses(self) -> dict[str, npt.NDArray[np.float64]]:
        """Losses by name, and ``"iteration"``: arrays of shape (records,)."""
        records: list[Any] = read_losses(self.folder)
        names = list(dict.fromkeys(name for record in records for name in record["losses"]))
        found = {"iteration": np.array([float(record["iteration"]) for record in records])}
        for name in names:
            values = [record["losses"].get(name, np.nan) for record in records]
            found[name] = np.array(values, float)
        return found

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Physical parameters of the readout chain; each name ends with the unit.

        Raises
        ------
        CpunetError
            If the run is not a readout chain.
        """
        told = describe_responses([self.folder])["runs"][0]
        return {name: float(value) for name, value in told["values"].items()}

    def loss_figure(self) -> Figure:
        """The losses of the training.

        Raises
        ------
        CpunetError
            If the run contains no losses.
        """
        records = read_losses(self.folder)
        if not records:
            raise CpunetError(f"{self.folder}: has kept no losses; train it again to see them")
        return loss_curves(records)

    def response_figure(self) -> Figure:
        """Step and impulse response of the readout chain, its tail and its noise.

        Raises
        ------
        CpunetError
            If the run is not a readout chain.
        """
        chain = chain_of(self.folder)
        tail_ns = self.recipe.preparation.samples_after * self.dt_ns
        return response_figure([chain], tail_ns=tail_ns)

    def translate(self, pulses: Any, out: str | Path | None = None, **how: Any) -> Translation:
        """Translate with this run, see `cpunet.translate`."""
        from cpunet.calls.translations import translate

        return translate(self, pulses, out, **how)

    def validate(
        self, sim: File, data: File, out: str | Path | None = None, **how: Any
    ) -> Report:
        """Validate this run, see `cpunet.validate`."""
        from cpunet.calls.reports import validate

        return validate(self, sim, data, out, **how)

    def _facts(self) -> dict[str, object]:
        info = self.info
        per = self.chi_square_per_moment
        used = {side: (info.get(side) or {}).get("used") for side in ("sim", "data")}
        return {
            "folder": self.folder,
            "recipe": info["recipe"],
            "trained on": info["peak"],
            "simulated pulses": used["sim"],
            "measured pulses": used["data"],
            "sampling": f"{self.dt_ns:g} ns",
            "chi-square per moment": None if per is None else f"{per:.2f}",
            "took": f"{float(info['seconds']):.0f} s on {info['device']}",
        }

    def __repr__(self) -> str:
        per = self.chi_square_per_moment
        fit = "" if per is None else f", chi-square per moment {per:.2f}"
        what = f"{self.info['recipe']}, {self.info['peak']}{fit}"
        return f"<{type(self).__name__} {self.folder}: {what}>"

    def _repr_html_(self) -> str:
        verdict = (self.info.get("fit") or {}).get("verdict")
        drawn = isinstance(self.recipe.generator, ResponseConfig)
        return part(
            "object",
            "cpunet run",
            self._facts(),
            lines=[verdict] if verdict else [],
            picture=notebook_picture(self.response_figure()) if drawn else "",
        )


def train(
    sim: File,
    data: File,
    out: str | Path,
    *,
    recipe: str | Path | Recipe = "fast",
    settings: Mapping[str, Any] | None = None,
    peak: str = "FEP",
    seed: int = 0,
    device: str = "auto",
    init: Run | str | Path | None = None,
    resume: bool = False,
    force: bool = False,
) -> Run:
    """Learn the translation from simulated and measured pulses, unpaired.

    Parameters
    ----------
    sim, data
        Simulated and measured pulses: a path, or `cpunet.InputFile` with reading options.
    out
        Folder of the run; it appears when the training is done.
    recipe
        ``"fast"`` (a readout chain), ``"paper"`` (networks), a YAML file, or a
        `Recipe`.
    settings
        Values that override those of a named recipe, such as ``{"training.steps": 20}``.
    peak
        Energies to train on: a line, or ranges in keV, such as ``"FEP,1000-1580"``.
    seed
        Seed of all random numbers.
    device
        ``"cpu"``, ``"cuda"`` or ``"auto"``.
    init
        A run of another detector or period to start from.
    resume
        Whether to resume an unfinished training of a network.
    force
        Whether to replace an output that this program wrote earlier.

    Returns
    -------
    Run
        The trained run.

    Raises
    ------
    CpunetError
        If an argument cannot be used; the message is one line that says what to do.
    """
    start = init.folder if isinstance(init, Run) else init
    info = train_run(
        as_input(sim, "sim"),
        as_input(data, "data"),
        Path(out),
        as_recipe(recipe, settings),
        TrainOptions(peak, seed, device, None if start is None else Path(start), resume, force),
    )
    return Run(Path(out), info)


def folder_of(run: Run | str | Path) -> Path:
    """The folder of a run."""
    return run.folder if isinstance(run, Run) else Path(run)
