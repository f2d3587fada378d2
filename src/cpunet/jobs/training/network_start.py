"""Inputs of a CycleGAN besides its pulses: noise, chain, teacher and first weights."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from cpunet.electronics.drawn_remains import TraceNoise
from cpunet.errors import CpunetError
from cpunet.jobs.common.measured_noise import measured_noise
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.training.chain_and_inverse import (
    Sides,
    known_response,
    match,
    remains_of_sides,
)
from cpunet.networks.linear_inverse import LinearInverse
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes.network_settings import PunetConfig, ResponseConfig
from cpunet.recipes.schema import Recipe
from cpunet.training.cyclegan import CycleGan
from cpunet.training.outside import Outside
from cpunet.training.run_folder import fill_networks, load_network, read_info, read_recipe
from cpunet.training.surroundings import MatchedChain, Surroundings


class NetworkStart(NamedTuple):
    """Inputs of a CycleGAN besides its pulses.

    Parameters
    ----------
    surroundings
        Noise, chain, teacher.
    fill
        Function that fills the networks with the weights of another run, or None.
    recipe
        Recipe with the chain as fitted, which can include ringing.
    told
        Entry on the chain for ``run.json``.
    """

    surroundings: Surroundings
    fill: Callable[[CycleGan], None] | None
    recipe: Recipe
    told: dict[str, Any]


def network_start(
    sides: Sides, recipe: Recipe, seed: int, init: Path | None, monitor: Monitor
) -> NetworkStart:
    """Measure noise and fit a chain, if the recipe requires them, and read `init`.

    Parameters
    ----------
    sides
        Prepared pulses, and the file of the measured ones.
    recipe
        Recipe of a CycleGAN.
    seed
        Seed of the fit of the chain.
    init
        Run to start from: of the same networks, or of a fitted chain. The latter is the
        teacher, or the starting point for the chain of the recipe.
    monitor
        Receiver of notes on the fit.

    Raises
    ------
    CpunetError
        If `init` does not fit the recipe, or there are no baselines to draw noise from.
    """
    matched = init is not None and isinstance(read_recipe(init).generator, ResponseConfig)
    fill = None
    if init is not None and not matched:
        _require_same_windows(init, recipe)
        fill = partial(fill_networks, init)
    if recipe.chain is not None:
        surroundings, recipe, told = _matched_chain(sides, recipe, seed, init, monitor)
        return NetworkStart(surroundings, fill, recipe, told)
    outside, told = None, {}
    if recipe.cyclegan.training.noise == "baselines":
        try:
            found = remains_of_sides(sides, recipe, monitor)
            noise, note = measured_noise(
                sides.data_file, sides.data, recipe.preparation, found.measured
            )
        except CpunetError as error:
            raise CpunetError(
                f"{sides.data_file.path}: no baselines to draw noise from ({error}); or train "
                "without it (--set training.noise=none)"
            ) from error
        if note is not None:
            monitor.note(f"warning: {note}")
        outside = Outside(
            TraceNoise(noise, found.drawn), sides.sim.energy_kev, recipe.preparation
        )
        if found.told is not None:
            told = {"fit": {"remains": found.told}}
    teacher = None
    if init is not None and matched:
        teacher = _teacher(init, sides, recipe)
    return NetworkStart(Surroundings(outside, teacher=teacher), fill, recipe, told)


def _matched_chain(
    sides: Sides, recipe: Recipe, seed: int, init: Path | None, monitor: Monitor
) -> tuple[Surroundings, Recipe, dict[str, Any]]:
    known = None if init is None else known_response(init, sides.sim.dt_ns)
    model, told, fitted = match(
        sides, recipe.of_chain, seed, lambda *_step: None, monitor, known
    )
    generator, inverse = model.get_submodule("ren"), model.get_submodule("iren")
    assert isinstance(generator, ResponseGenerator)
    assert isinstance(inverse, LinearInverse)
    outside = Outside(generator.trace_noise, sides.sim.energy_kev, recipe.preparation)
    assert recipe.chain is not None
    chain = recipe.chain.model_copy(update={"generator": fitted.generator})
    return (
        Surroundings(outside, MatchedChain(generator, inverse)),
        recipe.model_copy(update={"chain": chain}),
        told,
    )


def _teacher(init: Path, sides: Sides, recipe: Recipe) -> tuple[ResponseGenerator, Outside]:
    """The fitted chain of a run, with its own noise."""
    config, dt_ns = read_recipe(init).matching.generator, float(read_info(init)["dt_ns"])
    generator = ResponseGenerator(config, dt_ns)
    load_network(init, "ren", generator)
    noise = TraceNoise(generator.noise)
    return generator, Outside(noise, sides.sim.energy_kev, recipe.preparation)


def _require_same_windows(init: Path, recipe: Recipe) -> None:
    """Raise a `CpunetError` if the networks of a run were trained on other windows."""
    other = read_recipe(init)
    if not isinstance(other.generator, PunetConfig):
        return
    theirs, own = (
        (one.preparation.length, one.preparation.samples_before, one.network_length)
        for one in (other, recipe)
    )
    if theirs != own:
        raise CpunetError(
            f"{init}: its networks know windows of {other.network_length} of "
            f"{other.preparation.samples_before} + {other.preparation.samples_after} samples, "
            f"this recipe has {recipe.network_length} of {recipe.preparation.samples_before} + "
            f"{recipe.preparation.samples_after}; start from a run of the same windows"
        )
