"""Check the input of a parallel job once, before its processes start."""

from __future__ import annotations

from typing import Any

from cpunet.jobs.common.inputs import (
    InputFile,
    load_measured,
    load_simulated,
    require_both_sides,
    require_same_sampling,
)
from cpunet.jobs.common.monitor import Monitor
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.recipes.schema import Recipe


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
    simulated = load_simulated(sim, recipe, selection, monitor)
    measured = load_measured(data, recipe, selection, monitor)
    require_same_sampling(simulated, measured)
    require_both_sides(simulated, measured, selection)
    all_parameters(measured.prepared.pulses[:2], recipe.preparation, recipe.scores)
    return {"simulation": simulated.fingerprint(), "data": measured.fingerprint()}
