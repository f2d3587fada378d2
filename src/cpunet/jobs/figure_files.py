"""Single figures of a validation as files for a paper or a talk."""

from __future__ import annotations

from pathlib import Path

from cpunet.analysis.figures import loss_curves
from cpunet.analysis.report import DPI
from cpunet.errors import CpunetError
from cpunet.files import written_aside
from cpunet.jobs.evaluation import evaluate
from cpunet.jobs.figures import Maker, figure_makers
from cpunet.jobs.inputs import InputFile
from cpunet.jobs.monitor import Monitor
from cpunet.outputs import refuse_existing
from cpunet.training.run_folder import read_losses

QUIET = Monitor()
FORMATS = (".png", ".pdf", ".svg")
LOSSES = "losses"  # needs no pulses


def draw_figures(
    run: Path,
    names: list[str],
    sim: InputFile | None,
    data: InputFile | None,
    out: Path,
    *,
    suffix: str = ".png",
    truth: Path | None = None,
    rivals: bool = True,
    seed: int = 0,
    device: str = "auto",
    force: bool = False,
    monitor: Monitor = QUIET,
) -> list[Path]:
    """Draw figures by name into a folder.

    Parameters
    ----------
    run
        Folder of the training run.
    names
        As the report calls them, ``"SEP drift_time"`` or ``"SEP_drift_time"``, or a part of
        that: ``"single pulse"`` draws that of all peaks.
    sim, data
        Simulated and measured pulses; not needed for the losses.
    out
        Folder, made if need be.
    suffix
        ``.png``, ``.pdf`` or ``.svg``.
    truth, rivals, seed, device, monitor
        As for `cpunet.jobs.validate.validate_run`.
    force
        Replace existing files.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    CpunetError
        If a name fits no figure (the message lists them), pulses are needed and not given,
        or a file exists.
    """
    if suffix not in FORMATS:
        raise CpunetError(f"format {suffix!r} is not known; use {', '.join(FORMATS)}")
    if names == [LOSSES]:
        makers: dict[str, Maker] = {LOSSES: lambda: loss_curves(read_losses(run))}
    elif sim is None or data is None:
        raise CpunetError("simulated and measured pulses are needed; give --sim and --data")
    else:
        found = evaluate(
            run,
            sim,
            data,
            truth=truth,
            rivals=rivals,
            seed=seed,
            device=device,
            monitor=monitor,
        )
        makers = figure_makers(found)
    chosen = _chosen(names, makers)
    files = {name: out / f"{name.replace(' ', '_')}{suffix}" for name in chosen}
    for file in files.values():
        refuse_existing(file, force=force)
    for name, file in files.items():
        with written_aside(file) as aside:
            makers[name]().savefig(aside, format=suffix[1:], dpi=DPI)
    return list(files.values())


def _chosen(names: list[str], makers: dict[str, Maker]) -> list[str]:
    """Figures with a name that is asked for, or has it as a part."""
    found = []
    for wanted in names:
        plain = wanted.replace("_", " ").casefold()
        known = {name: name.replace("_", " ").casefold() for name in makers}
        fits = [n for n, p in known.items() if p == plain]
        fits = fits or [n for n, p in known.items() if plain in p]
        if not fits:
            raise CpunetError(f"no figure {wanted!r}; there are: {', '.join(makers)}")
        found += fits
    return list(dict.fromkeys(found))
