"""Demonstration on a test stand with known truth: stand, training, validation, report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from cpunet.electronics.chain import Electronics
from cpunet.errors import CpunetError
from cpunet.jobs.demo_parts import PARTS, is_there, remove_parts, require_same_parts
from cpunet.jobs.simulation.stand import write_stand
from cpunet.jobs.simulation.stand_plan import Kind, StandPlan
from cpunet.outputs import refuse_existing
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe
from cpunet.simulation.energy_windows import energy_windows
from cpunet.simulation.geometry import Detector
from cpunet.training.train import train
from cpunet.validation.report import Report
from cpunet.validation.validate import validate

_PEAK = "FEP"  # peak of the training
GLANCE = ("mean pulse", "current_amplitude", "single pulse")  # figures of a quick look
QUICK_LOOK = (
    "This is a quick look: with so few events the response is not well learned, and scores "
    "scatter by several points. The whole demonstration has more events and all figures."
)
_HALF_WINDOW_KEV = 0.5  # half-width of the deposited energies around each line


def demonstrate(
    electronics: Electronics,
    detector: Detector,
    recipe: Recipe,
    events: dict[str, int],
    out: Path,
    *,
    kind: Kind = "matched",
    seed: int = 0,
    device: str = "auto",
    force: bool = False,
    quick: bool = False,
) -> Report:
    """Make a stand, train on its FEP, and score every method on all its lines.

    Parameters
    ----------
    electronics, detector, kind
        See `cpunet.jobs.simulation.stand.make_stand`.
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
        Whether the report is a quick look, with a few figures only, and a note that says so.
    seed, device
        See `cpunet.train`.

    Returns
    -------
    Report
        The report, in its folder.

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
    windows = tuple(energy_windows(",".join(events), recipe.peaks, _HALF_WINDOW_KEV))
    plan = StandPlan.of(
        electronics, detector, windows, tuple(events.values()), kind=kind, seed=seed
    )
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
    truth = stand / "truth.npz"
    made = validate(run, sim, data, truth=truth, seed=seed, device=device)
    assert isinstance(made, Report)  # the stand has one channel
    if quick:
        made = at_a_glance(made)
    made.save(report)
    return replace(made, folder=report)


def at_a_glance(report: Report) -> Report:
    """A quick look: a few figures of the first peak that took no part in the training."""
    peak = next((peak for peak in report.values if peak != _PEAK), _PEAK)
    names = [f"{peak} {what}" for what in GLANCE]
    drawn = {name: draw for name, draw in (report.drawn or {}).items() if name in names}
    return replace(report, drawn=drawn, notes=(QUICK_LOOK, *report.notes))
