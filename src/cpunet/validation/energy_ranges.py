"""Energy ranges of a validation: peaks, their sidebands, and ranges of the continuum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cpunet.pulses.loading import InputSet
from cpunet.pulses.parameters import Values
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.validation.ae_energy import against_energy
from cpunet.validation.range_survival import survival_by_range

Range = tuple[float, float]

CUT_PEAK = "DEP"  # defines the A/E cuts


def validation_selection(names: Sequence[str], recipe: Recipe) -> EnergySelection:
    """Select named peaks and ranges, together with all sidebands and continua."""
    chosen = parse_selection(",".join(names), recipe.peaks)
    more = [band for _, bands in _lines(recipe).values() for band in bands]
    more += recipe.scores.continuum_kev.values()
    return replace(chosen, ranges_kev=(*chosen.ranges_kev, *more))


def range_survivals(
    sim: InputSet,
    data: InputSet,
    amplitudes: Mapping[str, Values],
    ae_survival: Mapping[str, Any],
    recipe: Recipe,
) -> dict[str, Any]:
    """A/E survival of gamma lines, sideband-subtracted, and of continua.

    Parameters
    ----------
    sim, data
        Prepared pulses of all energies of `validation_selection`.
    amplitudes
        Current amplitudes of these pulses by method, and of the ``"data"``.
    ae_survival
        Cuts by method, see `cpunet.validation.scoring.survivals`.
    recipe
        Recipe with the energy ranges.

    Returns
    -------
    dict
        Result of `survival_by_range`, or ``missing`` with the reason.
    """
    cuts = ae_survival.get(CUT_PEAK, {}).get("cut")
    if not cuts:
        reason = ae_survival.get("missing", f"there are no events of the {CUT_PEAK}")
        return {"missing": f"there is no A/E cut: {reason}"}
    methods = [method for method in amplitudes if method in cuts]
    sim_kev, data_kev = (side.prepared.pulses.energy_kev for side in (sim, data))
    return dict(
        survival_by_range(
            {method: amplitudes[method] for method in methods},
            {method: data_kev if method == "data" else sim_kev for method in methods},
            {m: np.nan if cuts[m] is None else cuts[m] for m in methods},
            {name: line for name, line in _lines(recipe).items() if name != CUT_PEAK},
            recipe.scores.continuum_kev,
        )
    )


def ae_against_energy(
    sim: InputSet, data: InputSet, amplitudes: Mapping[str, Values], recipe: Recipe
) -> dict[str, Any]:
    """Position and width of the single-site A/E peak against energy, for data and translation.

    All energies that were read are used, see `cpunet.validation.ae_energy.against_energy`.
    """
    return against_energy(
        {method: amplitudes[method] for method in ("data", "ren")},
        {"data": data.prepared.pulses.energy_kev, "ren": sim.prepared.pulses.energy_kev},
        {name: span for name, (span, _) in _lines(recipe).items()},
    )


def _lines(recipe: Recipe) -> dict[str, tuple[Range, list[Range]]]:
    """Range and sidebands of each peak."""
    near, far = recipe.scores.sideband_kev
    return {
        name: (
            (peak.energy_kev - peak.half_width_kev, peak.energy_kev + peak.half_width_kev),
            [
                (peak.energy_kev - far, peak.energy_kev - near),
                (peak.energy_kev + near, peak.energy_kev + far),
            ],
        )
        for name, peak in recipe.peaks.items()
    }
