"""Demonstration on a test stand with known truth: stand, training, validation, report."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from cpunet.electronics.chain import Electronics
from cpunet.electronics.stand import write_stand
from cpunet.electronics.stand_plan import StandPlan
from cpunet.errors import CpunetError
from cpunet.jobs.demo_parts import PARTS, is_there, remove_parts, require_same_parts
from cpunet.jobs.validation.evaluation import ValidateOptions
from cpunet.jobs.validation.validate import validate_run
from cpunet.outputs import refuse_existing
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe
from cpunet.simulation.energy_windows import wanted_events
from cpunet.simulation.geometry import Detector
from cpunet.simulation.shifted import Shift
from cpunet.training.train import train

_PEAK = "FEP"  # peak of the training
_HALF_WINDOW_KEV = 0.5  # half-width of the deposited energies around each line


def demonstrate(
    electronics: Electronics,
    detector: Detector,
    recipe: Recipe,
    events: dict[str, int],
    out: Path,
    *,
    kind: Literal["matched", "shifted"] = "matched",
    seed: int = 0,
    device: str = "auto",
    force: bool = False,
    quick: bool = False,
) -> dict[str, Any]:
    """Make a stand, train on its FEP, and score every method on all its lines.

    Parameters
    ----------
    electronics, detector
        See `cpunet.make_stand`.
    kind
        Whether the data's detector is the simulated one, or differs a little.
    recipe
        Recipe of the training.
    events
        Number of events per side, by line.
    out
        Folder of ``stand``, ``run`` and ``report``. Parts of an interrupted demonstration
        with the same options are kept.
    force
        Whether to make all parts again.
    quick
        Whether the report is a quick look, see `ValidateOptions`.
    seed, device
        See `cpunet.train`.

    Returns
    -------
    dict
        Content of the report's ``metrics.json``.

    Raises
    ------
    CpunetError
        If the report exists, an existing part was made with other options, a step fails, or,
        with `force`, something else is in the place of a part.
    """
    if out.exists() and not out.is_dir():
        raise CpunetError(f"{out}: is no folder; give another --out")
    stand, run, report = (out / part for part in PARTS)
    if is_there(out, "report"):
        refuse_existing(report, force=force)
    wanted = wanted_events(events, recipe.peaks, _HALF_WINDOW_KEV)
    shift = Shift.of(["default"]) if kind == "shifted" else None
    plan = StandPlan.of(electronics, detector, wanted, shift=shift, seed=seed)
    if force:
        remove_parts(out)
    require_same_parts(out, plan, recipe, _PEAK)
    if not is_there(out, "stand"):
        write_stand(plan, stand)
    sim, data = PulseFile(stand / "sim.lh5"), PulseFile(stand / "data.lh5")
    if not is_there(out, "run"):
        train(
            sim,
            data,
            run,
            recipe=recipe,
            peak=_PEAK,
            seed=seed,
            device=device,
            # an unfinished training is resumed, except with --force
            resume=recipe.training.method == "cyclegan" and not force,
            force=force,
        )
    return validate_run(
        run,
        sim,
        data,
        report,
        ValidateOptions(stand / "truth.npz", seed=seed, device=device, quick=quick),
    )
