"""The rival methods of a validation: fitted to the training's peak."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_remains import DrawnRemains, TraceNoise
from cpunet.electronics.rivals.base import Rival
from cpunet.electronics.rivals.registry import RIVALS
from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import InputFile, InputSet
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.common.noise import noise_of_traces
from cpunet.jobs.common.remains import measured_remains
from cpunet.pulses.peaks import EnergySelection
from cpunet.recipes.schema import Recipe

T = TypeVar("T")


@dataclass(eq=False)
class FittedRivals:
    """The rivals, and the noise that is added to what they and the truth say.

    Parameters
    ----------
    methods
        Fitted rivals by name.
    noise
        Drawn from the data's baselines, with remains of earlier pulses if these have some; None
        if there are none to draw from.
    missing
        Why a method, or the noise, is not there.
    """

    methods: dict[str, Rival] = field(default_factory=dict)
    noise: BaselineNoise | TraceNoise | None = None
    missing: dict[str, str] = field(default_factory=dict)


def fit_rivals(
    sim: InputSet,
    data: InputSet,
    data_file: InputFile,
    fit_on: EnergySelection,
    recipe: Recipe,
    *,
    remains: DrawnRemains | None = None,
    fitted: bool,
    monitor: Monitor,
) -> FittedRivals:
    """Fit every rival to unpaired pulses.

    Parameters
    ----------
    sim, data
        All prepared pulses.
    data_file
        The measured file, for its baselines.
    fit_on
        Energies that the rivals are fitted to: those of the training.
    recipe
        The run's settings.
    remains
        Of earlier pulses, as the run has learned them.
    fitted
        Whether there are to be any; there is noise in any case, for the truth.
    monitor
        Told of the progress.

    Returns
    -------
    FittedRivals
        A rival that cannot be fitted is missing, with its reason.
    """
    config, result = recipe.preparation, FittedRivals()
    # all rivals here; the untranslated simulation stands in the scores anyway
    kinds = {name: kind for name, kind in RIVALS.items() if fitted and name != "raw"}
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
    with monitor.stage("Fitting rivals", len(kinds)) as advance:
        for name, kind in kinds.items():

            def fit(kind: type[Rival] = kind) -> Rival:
                return kind.fit(fit_sim, fit_data, sim.dt_ns, config.samples_before)

            rival = _or_reason(result.missing, name, fit)
            if rival is not None:
                result.methods[name] = rival
            advance(1)
    for name, reason in result.missing.items():
        monitor.note(f"{name} is left out: {reason}")
    return result


def _or_reason(missing: dict[str, str], name: str, make: Callable[[], T]) -> T | None:
    """What is made, or None and the reason kept."""
    try:
        return make()
    except CpunetError as error:
        missing[name] = str(error)
        return None
