"""A response, its noise and its inverse from prepared pulses of both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from torch import nn

from cpunet.jobs.inputs import InputFile
from cpunet.jobs.monitor import Monitor
from cpunet.jobs.noise import measured_noise
from cpunet.networks.hybrid import HybridGenerator
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import HybridConfig, Recipe, ResponseConfig
from cpunet.training.inverse import fit_inverse
from cpunet.training.loop import Record
from cpunet.training.matching import fit_response
from cpunet.training.residual import fit_residual

POOR_FIT = 3.0  # chi-square per moment from which on a response does not describe the data


@dataclass(frozen=True, eq=False)
class Sides:
    """Prepared pulses of both sides, and the file of the measured ones."""

    sim: Pulses
    data: Pulses
    data_file: InputFile


def _with_found_ringing(recipe: Recipe, found: ResponseConfig) -> Recipe:
    """The recipe of the response as it was fitted: it may have begun to ring."""
    if not isinstance(recipe.generator, ResponseConfig):
        return recipe
    rings = {"ringing_mhz": found.ringing_mhz}
    return recipe.model_copy(update={"generator": recipe.generator.model_copy(update=rings)})


def match(
    sides: Sides,
    recipe: Recipe,
    seed: int,
    listen: Callable[[list[Record]], None],
    monitor: Monitor,
) -> tuple[nn.Module, dict[str, Any], Recipe]:
    """Measure the noise, fit the response, and invert it.

    Parameters
    ----------
    sides
        What to fit to.
    recipe
        With a response to be matched.
    seed
        Of everything random.
    listen
        Given a record for each step of the fit.
    monitor
        Told of what is to be noted.

    Returns
    -------
    tuple
        A module with ``ren`` and ``iren``, what ``run.json`` is to say of the fit, and the
        recipe of the response as it was fitted.

    Raises
    ------
    CpunetError
        If there are too few pulses or baselines, or the fit diverges.
    """
    noise, note = measured_noise(sides.data_file, sides.data, recipe.preparation)
    if note is not None:
        monitor.note(f"warning: {note}")

    def tell(step: int, chi_square: float) -> None:
        listen([{"iteration": step, "rate": 0.0, "losses": {"chi_square": chi_square}}])

    response, fit = fit_response(
        sides.sim.waveforms,
        sides.data.waveforms,
        sides.sim.energy_kev,
        noise,
        recipe,
        seed=seed,
        listener=tell,
    )
    if fit.chi_square > POOR_FIT * fit.moments:
        monitor.note(
            f"warning: the response describes the data poorly, chi-square "
            f"{fit.chi_square:.0f} for {fit.moments} moments; look at the report"
        )
    recipe = _with_found_ringing(recipe, response.config)
    ren = ResponseGenerator(recipe.matching.generator, sides.sim.dt_ns)
    ren.response = response
    ren.set_noise(noise)
    chain, parts, more = ren, {}, {}
    if isinstance(recipe.generator, HybridConfig):
        residual, kept = fit_residual(
            chain,
            sides.sim.waveforms,
            sides.data.waveforms,
            sides.sim.energy_kev,
            recipe,
            seed=seed,
        )
        if not kept.kept:
            monitor.note("the residual does not help held-out pulses and is left out")
        # beside the chain, not in it: what reads chains finds it where it always is
        ren, parts, more = (
            HybridGenerator(chain, residual),
            {"residual": residual},
            asdict(kept),
        )
    iren = fit_inverse(ren, sides.sim.waveforms, sides.sim.energy_kev, recipe, seed=seed)
    told = {
        "parameters": response.describe(),
        **asdict(fit),
        "noise": {"baselines": noise.n_baselines, "rms": noise.rms},
    }
    if more:
        told["residual"] = more
    return nn.ModuleDict({"ren": chain, "iren": iren} | parts), {"fit": told}, recipe
