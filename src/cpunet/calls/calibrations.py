"""`cpunet.calibrate`, and the calibrated run that it returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from matplotlib.figure import Figure
from pydantic import Field

from cpunet.calibration.titles import titled
from cpunet.errors import CpunetError
from cpunet.html_pages import part
from cpunet.jobs.calibration.calibrate import CALIBRATION, DETECTOR, SETTINGS, SIM, Calibration
from cpunet.jobs.calibration.calibration_inputs import Freedom, Start
from cpunet.pulses.reading.files import Source, pulse_file
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.settings import read_json, read_settings
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hit_sources import HitFile
from cpunet.simulation.settings import SimulationSettings
from cpunet.training.run import Run
from cpunet.validation.calibration_figures import calibration_figures


class CalibratedRun(Run):
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

    @property
    def physics(self) -> dict[str, dict[str, Any]]:
        """By parameter: ``value``, ``error``, ``simulated``, ``prior`` and others."""
        return dict(self.content["parameters"])

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

    def _repr_html_(self) -> str:
        rows = [
            [
                titled(name),
                f"{one['value']:.5g} ± {one['error']:.2g}",
                f"{one['simulated']:.5g}",
            ]
            for name, one in self.physics.items()
        ]
        head = ["physics", "calibrated", "as simulated"]
        shown = part(
            "object", "", head=head, rows=rows, lines=map(titled, self.content["notes"])
        )
        return shown + super()._repr_html_()


def calibrate(
    sim: Source | HitFile,
    data: Source,
    out: str | Path,
    *,
    detector: str | Path | Detector | None = None,
    settings: SimulationSettings | None = None,
    free: Sequence[str] | None = None,
    fixed: Sequence[str] = (),
    priors: Mapping[str, tuple[float, float]] | None = None,
    peak: str = "FEP",
    recipe: str | Path | Recipe = "fast",
    events: int = 3000,
    seed: int = 0,
    force: bool = False,
) -> CalibratedRun:
    """Fit detector and readout together, and train on the resulting simulation.

    Parameters
    ----------
    sim
        Pulses of ``cpunet simulate`` or ``cpunet stand``, with their hits; or
        `cpunet.HitFile`, hits that are simulated first, in the given `detector`.
    data
        Measured pulses.
    out
        Folder of the run.
    detector, settings
        Detector and settings of the simulation; those of `sim` by default.
    free
        Free parameters, such as ``["temperature", "impurity"]``; None for those that the data
        determine.
    fixed
        Parameters that stay as simulated.
    priors
        Value and error by name, such as ``{"depletion_voltage": (2100, 50)}``.
    peak
        Peak, or ranges of energy, to calibrate on.
    recipe
        ``"fast"``, a YAML file, or a `Recipe`.
    events
        Maximum number of simulated events that are drifted repeatedly.
    seed
        Seed of all random numbers.
    force
        Whether to replace an output that this program wrote earlier.

    Returns
    -------
    CalibratedRun
        The run, with the calibrated physics.

    Raises
    ------
    CpunetError
        If an argument cannot be used, or the data are of another detector.
    """
    known = detector if isinstance(detector, Detector | None) else read_detector(str(detector))
    start = Start(
        sim=None if isinstance(sim, HitFile) else pulse_file(sim),
        hits=replace(sim, path=Path(sim.path)) if isinstance(sim, HitFile) else None,
        detector=known,
        settings=settings,
    )
    given = [f"{name}={float(v)!r}±{float(e)!r}" for name, (v, e) in (priors or {}).items()]
    job = Calibration(
        start,
        pulse_file(data),
        load_recipe(recipe),
        Freedom.of("auto" if free is None else ",".join(free), ",".join(fixed), given),
        peak=peak,
        events=events,
        seed=seed,
    )
    job.run(Path(out), force=force)
    return CalibratedRun.load(out)
