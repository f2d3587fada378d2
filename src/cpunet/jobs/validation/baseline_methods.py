"""The baseline methods of a validation, fitted to the peak of the training."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from cpunet.electronics.baseline_methods.base import BaselineMethod
from cpunet.electronics.baseline_methods.registry import BASELINE_METHODS
from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_remains import DrawnRemains, TraceNoise
from cpunet.electronics.measured_noise import noise_of_traces
from cpunet.electronics.measured_remains import measured_remains
from cpunet.errors import CpunetError
from cpunet.progress import stage
from cpunet.pulses.loading import InputSet
from cpunet.pulses.peaks import EnergySelection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(eq=False)
class FittedBaselineMethods:
    """The fitted baseline methods, and the noise that is added to them and to the truth.

    Parameters
    ----------
    methods
        Fitted baseline methods by name.
    noise
        Noise drawn from the baselines of the data, with remains of earlier pulses if the data
        have any; None if there are no baselines.
    missing
        Reasons why methods or the noise are missing, by name.
    """

    methods: dict[str, BaselineMethod] = field(default_factory=dict)
    noise: BaselineNoise | TraceNoise | None = None
    missing: dict[str, str] = field(default_factory=dict)


def fit_baseline_methods(
    sim: InputSet,
    data: InputSet,
    data_file: PulseFile,
    fit_on: EnergySelection,
    recipe: Recipe,
    *,
    remains: DrawnRemains | None = None,
    fitted: bool,
) -> FittedBaselineMethods:
    """Fit every baseline method to unpaired pulses.

    Parameters
    ----------
    sim, data
        All prepared pulses of both sides.
    data_file
        Measured file, for its baselines.
    fit_on
        Energies on which the methods are fitted: those of the training.
    recipe
        Recipe of the run.
    remains
        Remains of earlier pulses as learned by the run.
    fitted
        Whether to fit the methods; the noise is measured in any case, for the truth.

    Returns
    -------
    FittedBaselineMethods
        Methods that cannot be fitted are listed as missing, with the reason.
    """
    config, result = recipe.preparation, FittedBaselineMethods()
    # all but the untranslated simulation, which is scored anyway
    kinds = {name: kind for name, kind in BASELINE_METHODS.items() if fitted and name != "raw"}
    there = remains is not None and remains.law.rate_khz > 0
    found = measured_remains(data_file, config)[0] if there else None
    noise = _or_reason(
        result.missing, "noise", lambda: noise_of_traces(data_file, config, found)
    )
    if noise is not None:
        result.noise = TraceNoise(noise, remains) if there else noise
    fit_sim, fit_data = (
        side.prepared.pulses.waveforms[fit_on.select(side.prepared.pulses.energy_kev)]
        for side in (sim, data)
    )
    with stage("Fitting baseline methods", len(kinds)) as bar:
        for name, kind in kinds.items():
            fit = partial(kind.fit, fit_sim, fit_data, sim.dt_ns, config.samples_before)
            method = _or_reason(result.missing, name, fit)
            if method is not None:
                result.methods[name] = method
            bar.update(1)
    for name, reason in result.missing.items():
        log.info(f"{name} is left out: {reason}")
    return result


def _or_reason(missing: dict[str, str], name: str, make: Callable[[], T]) -> T | None:
    """The result of `make`, or None, with the reason recorded in `missing`."""
    try:
        return make()
    except CpunetError as error:
        missing[name] = str(error)
        return None
