"""The input of jobs of many processes, looked at once before any of them starts."""

from __future__ import annotations

from typing import Any

from cpunet.jobs.common.inputs import (
    InputFile,
    InputSet,
    load_measured,
    load_simulated,
    require_same_sampling,
)
from cpunet.jobs.common.monitor import Monitor
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.recipes.schema import Recipe

_TOLD = ("dt_ns", "used", "sha256")  # not the name: a file may have been moved


def fingerprints(
    sim: InputFile, data: InputFile, recipe: Recipe, peak: str, monitor: Monitor
) -> dict[str, Any]:
    """What the pulses of both files are known by when a job goes on.

    Bad input is told of here, in a line.  What is compiled on first use is compiled here and
    kept, so that the processes do not all compile it at once.

    Raises
    ------
    CpunetError
        If the input cannot be used.
    """
    selection = parse_selection(peak, recipe.peaks)
    sides: dict[str, InputSet] = {
        "simulation": load_simulated(sim, recipe, selection, monitor),
        "data": load_measured(data, recipe, selection, monitor),
    }
    require_same_sampling(sides["simulation"], sides["data"])
    all_parameters(sides["data"].prepared.pulses[:2], recipe.preparation, recipe.scores)
    found = {}
    for side, pulses in sides.items():
        provenance = pulses.provenance()
        found[side] = {key: provenance[key] for key in _TOLD}
    return found
