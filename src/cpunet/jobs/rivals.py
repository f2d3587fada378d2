"""The rival methods of a validation: fitted to the training's peak, applied to every pulse."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from cpunet.analysis.style import NO_NOISE
from cpunet.electronics.finishing import finish
from cpunet.electronics.rivals.base import Rival
from cpunet.electronics.rivals.registry import RIVALS
from cpunet.electronics.rivals.translating import translate_like_data
from cpunet.errors import CpunetError
from cpunet.jobs.inputs import InputFile, InputSet
from cpunet.jobs.monitor import Monitor
from cpunet.jobs.noise import noise_of_traces
from cpunet.pulses.container import FloatArray
from cpunet.pulses.peaks import EnergySelection
from cpunet.recipes.schema import Recipe

T = TypeVar("T")


@dataclass(eq=False)
class RivalWindows:
    """What the rivals, and the truth if it is known, make of the simulated pulses.

    Parameters
    ----------
    noisy
        Windows (n, length) by method, with noise drawn from the data's baselines; rows
        that cannot be prepared are NaN. Empty if there is no noise to draw from.
    clean
        The same without noise.
    fits
        Fitted numbers by method.
    missing
        Why a method, or the noise, is not there.
    """

    noisy: dict[str, FloatArray] = field(default_factory=dict)
    clean: dict[str, FloatArray] = field(default_factory=dict)
    fits: dict[str, Mapping[str, float]] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)

    def methods(self) -> dict[str, FloatArray]:
        """All of them by the names of ``metrics.json``."""
        return self.noisy | {f"{name}{NO_NOISE}": w for name, w in self.clean.items()}


def rival_windows(
    sim: InputSet,
    data: InputSet,
    data_file: InputFile,
    fit_on: EnergySelection,
    recipe: Recipe,
    *,
    fitted: bool = True,
    response: FloatArray | None,
    seed: int,
    monitor: Monitor,
) -> RivalWindows:
    """Fit every rival to unpaired pulses and translate all simulated ones.

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
    fitted
        Whether there are to be any; the truth is finished in any case.
    response
        True noise-free records of the simulated pulses, if known.
    seed
        Of the noise.
    monitor
        Told of the progress.

    Returns
    -------
    RivalWindows
        A rival that cannot be fitted is missing, with its reason.
    """
    config, result = recipe.preparation, RivalWindows()
    simulated = sim.prepared.pulses
    # all rivals here; the untranslated simulation stands in the scores anyway
    kinds = {name: kind for name, kind in RIVALS.items() if fitted and name != "raw"}
    noise = _or_reason(result.missing, "noise", lambda: noise_of_traces(data_file, config))
    fit_sim, fit_data = (
        side.prepared.pulses.waveforms[fit_on.select(side.prepared.pulses.energy_kev)]
        for side in (sim, data)
    )
    with monitor.stage("Fitting rivals", len(kinds) + (response is not None)) as advance:
        for name, kind in kinds.items():

            def translated(name: str = name, kind: type[Rival] = kind) -> None:
                rival = kind.fit(fit_sim, fit_data, sim.dt_ns, config.samples_before)
                result.clean[name] = translate_like_data(rival, simulated, config).waveforms
                result.fits[name] = rival.describe()
                if noise is not None:
                    result.noisy[name] = translate_like_data(
                        rival, simulated, config, noise=noise, seed=seed
                    ).waveforms

            _or_reason(result.missing, name, translated)
            advance(1)
        if response is not None:
            result.clean["truth"] = finish(response, config, dt_ns=sim.dt_ns)
            if noise is not None:
                result.noisy["truth"] = finish(
                    response,
                    config,
                    dt_ns=sim.dt_ns,
                    noise=noise,
                    energy_kev=simulated.energy_kev,
                    seed=seed,
                )
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
