"""Check the input of a parallel job once, before its processes start."""

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

_TOLD = ("dt_ns", "used", "sha256")  # not the name: a file can be moved


def fingerprints(
    sim: InputFile, data: InputFile, recipe: Recipe, peak: str, monitor: Monitor
) -> dict[str, Any]:
    """Fingerprints of the pulses of both files, which identify them when a job is resumed.

    Bad input raises an error here.  Code that is compiled on first use is compiled and cached
    here, so that the processes do not all compile it at once.

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
