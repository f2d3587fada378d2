"""Validate a run: scores per peak, figures and a report."""

from __future__ import annotations

from collections.abc import Container, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cpunet.jobs.validation.evaluation import Evaluation, ValidateOptions, evaluate
from cpunet.jobs.validation.when_asked import WhenAsked
from cpunet.outputs import folder_written_aside
from cpunet.progress import Stage, stage
from cpunet.pulses.parameters import PARAMETERS
from cpunet.pulses.reading.files import PulseFile
from cpunet.training.run import Run, RunLike, as_run
from cpunet.validation.report_folder import REPORT, VALUES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cpunet.jobs.validation.drawings import Drawing

AS_USUAL = ValidateOptions()
GLANCE = ("mean pulse", "current_amplitude", "single pulse")  # figures of a quick look
QUICK_LOOK = (
    "This is a quick look: with so few events the response is not well learned, and scores "
    "scatter by several points. The whole demonstration has more events and all figures."
)


def validate_run(
    run: RunLike,
    sim: PulseFile,
    data: PulseFile,
    out: Path,
    how: ValidateOptions = AS_USUAL,
    *,
    force: bool = False,
) -> dict[str, Any]:
    """Score a run on simulated and measured pulses and write the report folder.

    Every peak of the recipe is scored, and the energies of the training if they are not a
    peak.  SEP and DEP are not used in the training: they are the test.

    Parameters
    ----------
    run
        A trained run, or its folder.
    sim, data
        Simulated and measured pulses.
    out
        Report folder: ``metrics.json``, figures, ``report.html``, and ``parameters.npz``, the
        parameters of each pulse under ``PEAK/METHOD/PARAMETER``.

    Returns
    -------
    dict
        Content of ``metrics.json``.

    Raises
    ------
    CpunetError
        If the input cannot be used, or no peak can be scored.
    """
    return validated(run, sim, data, out, how, force=force)[0].metrics


def validated(
    run: RunLike,
    sim: PulseFile,
    data: PulseFile,
    out: Path | None,
    how: ValidateOptions = AS_USUAL,
    *,
    force: bool = False,
) -> tuple[Evaluation, dict[str, Drawing]]:
    """Like `validate_run`, also without `out`; return results, and functions that draw."""
    run = as_run(run)
    sim, data = run.sim.reading(sim), run.data.reading(data)
    if out is None:
        found = evaluate(run, sim, data, how)
        return found, drawings(found)
    read = (run.folder, *sim.files, *data.files, how.truth)
    with folder_written_aside(out, REPORT, *read, force=force) as folder:
        found = evaluate(run, sim, data, how)
        to_draw = drawings(found)
        if how.quick:
            to_draw = {name: to_draw[name] for name in _at_a_glance(found, to_draw)}
        found.forget_noisy()
        from cpunet.validation.report import write_report

        parameters = {
            f"{peak}/{method}/{name}": of_method[name]
            for peak, of_peak in found.values.items()
            for method, of_method in of_peak.items()
            for name in PARAMETERS
            if name in of_method
        }
        np.savez_compressed(folder / VALUES, allow_pickle=False, **parameters)
        with stage("Drawing", len(to_draw)) as bar:
            notes = _notes(run, found.metrics, how)
            figures = {name: partial(_drawn, one, bar) for name, one in to_draw.items()}
            write_report(folder, found.metrics, WhenAsked(figures), notes)
    return found, to_draw


def drawings(found: Evaluation) -> dict[str, Drawing]:
    """Functions that draw the figures of a validation, by name."""
    # imported late: matplotlib is not needed while the pulses take most memory
    from cpunet.jobs.validation import drawings as figures

    return figures.drawings(found)


def _at_a_glance(found: Evaluation, names: Container[str]) -> list[str]:
    """Figures of a quick look, of the first peak that took no part in the training."""
    scored = [peak for peak in found.values if found.values[peak]]
    peak = next((peak for peak in scored if peak != found.run.peak), scored[0])
    return [name for what in GLANCE if (name := f"{peak} {what}") in names]


def _of_remains(metrics: Mapping[str, Any]) -> list[str]:
    """Remarks on remains of earlier pulses in the data, if they are certain."""
    told = metrics["remains"] or {}
    if not told.get("rate_khz"):
        return []
    shares = ", ".join(
        f"{share['measured']:.1f} ({share['law']:.1f}) above {size.partition('_')[0]} keV"
        for size, share in told["percent_above"].items()
    )
    return [
        f"Traces of the training lie on remains of earlier pulses, {told['rate_khz']:.2f} ± "
        f"{told['rate_error_khz']:.2f} kHz decaying with {told['decay_us']:.1f} µs: percent of "
        f"the traces, measured (by the law), {shares}. All translations and the truth have "
        "remains drawn by this law, as likely as they pass the quality cuts."
    ]


def _drawn(drawing: Drawing, bar: Stage) -> Figure:
    """Draw a figure and report progress."""
    figure = drawing()
    bar.update(1)
    return figure


def _notes(run: Run, metrics: Mapping[str, Any], how: ValidateOptions) -> list[str]:
    notes = [QUICK_LOOK] if how.quick else []
    notes += [
        f"Peaks other than {run.peak} took no part in the training.",
        "IoU is the overlap of two distributions in percent. Two samples of the same "
        "distribution do not reach 100 at finite size: the ceiling is what data score "
        "against data at these sizes.",
    ]
    notes += _of_remains(metrics)
    if how.truth is None:
        notes.append("No truth was given, so single pulses are not scored.")
    return notes
