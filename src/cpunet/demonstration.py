"""The whole job on a test stand with its truth: stand, training, validation, report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cpunet
from cpunet.outputs import refuse_existing

EVENTS, FEW = "FEP=2500,SEP=1000,DEP=1000", "FEP=1000,SEP=250,DEP=250"
COARSE = ("step_ns=2",)  # of the drift, in a quick look: half the time
GLANCE = ("SEP mean pulse", "SEP current amplitude", "SEP single pulse")
QUICK_LOOK = (
    "This is a quick look: with so few events the response is not well learned, and scores "
    "scatter by several points. The whole demonstration has more events and all figures."
)


def demo(
    out: str | Path = "demo", *, quick: bool = False, force: bool = False
) -> cpunet.Report:
    """Simulate, digitise, train, translate and validate on a stand with a given answer.

    Parameters
    ----------
    out
        Folder of stand, run and report.
    quick
        Few events, drifted in coarser steps; the scores and three figures.
    force
        Replace an existing demonstration.

    Raises
    ------
    CpunetError
        If a part of it exists, unless `force`, or something else is in its place.

    Examples
    --------
    cpunet demo --out demo

    cpunet demo --quick
    """
    parts = [Path(out) / part for part in ("stand", "run", "report")]
    for part in parts:
        refuse_existing(part, force=force)
    in_stand, in_run, in_report = parts
    size, steps = (FEW, COARSE) if quick else (EVENTS, ())
    stand = cpunet.make_stand(in_stand, events=size, settings=steps, force=force)
    run = cpunet.train(stand.sim, stand.data, in_run, force=force)
    assert isinstance(run, cpunet.Run)  # the stand has one channel
    report = cpunet.validate(run, stand.sim, stand.data, truth=stand.truth)
    assert isinstance(report, cpunet.Report)
    if quick:
        drawn = {name: draw for name, draw in (report.drawn or {}).items() if name in GLANCE}
        report = replace(report, drawn=drawn, notes=(QUICK_LOOK,))
    report.save(in_report, force=force)
    return replace(report, folder=in_report)
