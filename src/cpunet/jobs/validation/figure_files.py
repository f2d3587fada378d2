"""Write single figures of a validation to files for a paper or a talk."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from cpunet.analysis.html_pages import DPI
from cpunet.analysis.report_folder import REPORT
from cpunet.errors import CpunetError
from cpunet.files import written_aside
from cpunet.jobs.common.inputs import InputFile
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.validation.drawings import LOSSES, Drawing, drawings, figure_names, of_losses
from cpunet.jobs.validation.evaluation import ValidateOptions, evaluate
from cpunet.jobs.validation.figure_store import STORE, made_of, read_drawings, write_drawings
from cpunet.outputs import made_here, refuse_existing
from cpunet.training.run_folder import read_info, read_losses, read_recipe

QUIET, AS_USUAL = Monitor(), ValidateOptions()
FORMATS = (".png", ".pdf", ".svg")


def draw_figures(
    folder: Path,
    names: list[str],
    sim: InputFile | None,
    data: InputFile | None,
    out: Path,
    *,
    suffix: str = ".png",
    how: ValidateOptions = AS_USUAL,
    force: bool = False,
    monitor: Monitor = QUIET,
) -> list[Path]:
    """Draw figures by name into a folder.

    They are drawn from the results that a validation stored in its report.  For a run without
    a report, the pulses are scored once and the results are stored in its folder.

    Parameters
    ----------
    folder
        Report folder of a validation, or folder of a training run.
    names
        Names as in the report, ``"SEP drift_time"`` or ``"SEP_drift_time"``, or parts of
        them: ``"single pulse"`` draws the single pulses of all peaks.
    sim, data
        Simulated and measured pulses, for a run; not needed if results of the run are stored,
        nor for its losses.
    out
        Output folder, created if missing.
    suffix
        File format: ``.png``, ``.pdf`` or ``.svg``.
    how
        How the pulses are scored.

    Returns
    -------
    list of Path
        Paths of the files written.

    Raises
    ------
    CpunetError
        If a name matches no figure (the message lists them), required pulses are missing,
        or a file exists.
    """
    if suffix not in FORMATS:
        raise CpunetError(f"format {suffix!r} is not known; use {', '.join(FORMATS)}")
    read = [folder, how.truth, *(file for side in (sim, data) if side for file in side.files)]

    def files_of(known: Collection[str]) -> dict[str, Path]:
        chosen = chosen_names(names, known)
        files = {name: out / f"{name.replace(' ', '_')}{suffix}" for name in chosen}
        for file in files.values():
            refuse_existing(file, *read, force=force)
        return files

    found = _stored(folder, names, sim, data)
    if found is None:
        assert sim is not None  # otherwise `_stored` would have raised
        assert data is not None
        files_of(_possible(folder))  # before scoring, which takes a minute
        info = read_info(folder)
        sim, data = sim.as_before(info, "sim"), data.as_before(info, "data")
        found = _scored(folder, sim, data, how, monitor)
    files = files_of(found)
    for name, file in files.items():
        with written_aside(file) as aside:
            found[name].draw().savefig(aside, format=suffix[1:], dpi=DPI)
    return list(files.values())


def _scored(
    run: Path, sim: InputFile, data: InputFile, how: ValidateOptions, monitor: Monitor
) -> dict[str, Drawing]:
    """Load figures stored in the run folder if their inputs agree; else score and store."""
    made = made_of(run, sim, data, how)
    store = run / STORE
    if store.is_file():
        found, of = read_drawings(store)
        if of == made:
            return found
    found = drawings(evaluate(run, sim, data, how, monitor))
    try:
        with written_aside(store) as aside:
            write_drawings(aside, found, made)
    except CpunetError as error:
        monitor.note(f"warning: {error}; the next figure takes as long")
    return found


def chosen_names(names: list[str], known: Collection[str]) -> list[str]:
    """Names of the figures that match the given names in full or in part.

    Raises
    ------
    CpunetError
        If a name matches no figure; the message lists them.

    Examples
    --------
    >>> chosen_names(["noise", "sep_mean_pulse"], ["SEP mean pulse", "SEP noise", "DEP noise"])
    ['SEP noise', 'DEP noise', 'SEP mean pulse']
    """
    found = []
    plain = {name: name.replace("_", " ").casefold() for name in known}
    for wanted in names:
        asked = wanted.replace("_", " ").casefold()
        fits = [n for n, p in plain.items() if p == asked]
        fits = fits or [n for n, p in plain.items() if asked in p]
        if not fits or not asked.strip():
            raise CpunetError(f"no figure {wanted[:60]!r}; there are: {', '.join(known)}")
        found += fits
    return list(dict.fromkeys(found))


def _stored(
    folder: Path, names: list[str], sim: InputFile | None, data: InputFile | None
) -> dict[str, Drawing] | None:
    """Figures that need no scoring; None if pulses are given for scoring."""
    if made_here(folder, REPORT):
        if sim is not None or data is not None:
            raise CpunetError(
                f"{folder}: is a report, whose stored results are drawn; leave out --sim and "
                "--data, or give the run"
            )
        if not (folder / STORE).is_file():
            raise CpunetError(
                f"{folder}: stores no results to draw (an older report); validate again, or "
                "give the run with --sim and --data"
            )
        return read_drawings(folder / STORE)[0]
    if names == [LOSSES]:
        return {LOSSES: of_losses(read_losses(folder))}
    if sim is not None and data is not None:
        return None
    if (folder / STORE).is_file() and sim is None and data is None:
        return read_drawings(folder / STORE)[0]
    chosen_names(names, _possible(folder))
    raise CpunetError(
        "simulated and measured pulses are needed; give --sim and --data, or a report"
    )


def _possible(run: Path) -> list[str]:
    """Names of the figures that a validation of a run can have."""
    peaks = [*read_recipe(run).peaks, str(read_info(run)["peak"])]
    return figure_names(dict.fromkeys(peaks))
