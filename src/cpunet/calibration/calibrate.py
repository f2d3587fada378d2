"""Calibrate the physics of a simulation on a measurement, and write a run of the result."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from cpunet.calibration.calibrated_run import (
    CALIBRATION,
    DETECTOR,
    DPI,
    MIDDLE,
    SETTINGS,
    SIM,
    Calibration,
    ExpectedErrors,
    Plan,
)
from cpunet.calibration.nearby import Simulator
from cpunet.calibration.nuisances import Freedom, Physics, freedom, titled
from cpunet.calibration.search import Search
from cpunet.electronics.measured import trace_noise
from cpunet.errors import CpunetError
from cpunet.outputs import folder_written_aside, refuse_existing, refuse_inputs
from cpunet.processes import keep_freed_memory, one_thread_for_matrices
from cpunet.progress import stage
from cpunet.pulses.channels import CHANNEL, Outcome, Pair, each_channel, paired
from cpunet.pulses.loading import (
    InputSet,
    load_pulses,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import ALL, PulseFile, ReadOptions, Source
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.settings import require_seed, yaml_text
from cpunet.simulation.simulate import HitFile, StoredSimulation, simulate
from cpunet.training.chain_fit import with_settings
from cpunet.training.energy_bands import MIN_PULSES
from cpunet.training.job import TrainingJob, train_chain
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.run import RUN

log = logging.getLogger(__name__)

# Numbers of pulses per side for which a plan gives the errors.
PLANNED = ("1000", MIDDLE, "40000")
# Chi-square per function beyond which the data are of another detector.
HOPELESS = 50.0


def calibrate(
    sim: Source,
    data: Source,
    out: str | Path | None = None,
    *,
    free: Sequence[str] = (),
    prior: Sequence[str] | Mapping[str, tuple[float, float]] = (),
    plan: bool = False,
    peak: str = "FEP",
    recipe: str | Path | Recipe = "fast",
    events: int = 3000,
    seed: int = 0,
    read: ReadOptions = ReadOptions(),
    force: bool = False,
) -> Calibration | Plan | Outcome[Calibration | Plan]:
    """Calibrate the detector and its electronics together: temperature, impurities, readout.

    The folder is a run like those of `cpunet.train`, and contains the calibrated
    ``detector.yaml`` and ``settings.yaml``, ``sim.lh5`` (all events, simulated again with
    them), ``calibration.json`` and its figures, ``pulls.png`` and ``directions.png``.

    Parameters
    ----------
    sim
        Output of cpunet simulate or stand, with its hits; of all channels, as
        ``sims/{channel}.lh5``.
    data
        Measured pulses.
    out
        Run folder to make; may be left out with a plan.
    free
        Parameters, as temperature,impurity; by default those that the data tell.
    prior
        NAME=VALUE±ERROR (or +-) of a parameter or of depletion_voltage (repeatable).
    plan
        Only print the expected sensitivity to the physics, before any fit.
    peak
        Energies to calibrate on: FEP, SEP, DEP or ranges in keV.
    recipe
        fast, or a YAML file of your own.
    events
        Simulated events, at most, that are drifted again and again.
    seed
        Seed of all random numbers.
    read
        How the files are read.
    force
        Replace existing output.

    Returns
    -------
    Calibration, Plan or Outcome
        The run, with the calibrated physics; or the expected errors of the physics; with
        ``data_table="all"`` those of each channel.

    Raises
    ------
    CpunetError
        If the inputs cannot be used, the detector cannot be simulated with the physics that
        the data require, or the data are clearly from another detector.

    Examples
    --------
    cpunet calibrate --sim sim.lh5 --data raw.lh5 --out run

    cpunet calibrate --sim sim.lh5 --data raw.lh5 --out run --free temperature,impurity \
--prior depletion_voltage=2100±50

    cpunet calibrate --sim sim.lh5 --data raw.lh5 --plan
    """
    if out is None and not plan:
        raise CpunetError("give `out`, the run folder to make, or `plan`")
    sides = read.files(sim, data)
    target = None if out is None else Path(out)
    if target is not None and not isinstance(recipe, Recipe):
        refuse_inputs(target, recipe)
    settings = load_recipe(recipe)
    _ = settings.matching  # without a chain nothing is calibrated with a detector
    require_seed(seed)
    chosen = freedom(free, prior)
    start = partial(_search, recipe=settings, free=chosen, peak=peak, events=events, seed=seed)
    act: Callable[[str, Pair, Path | None], Calibration | Plan]
    act = partial(_planned, start, force)
    if not plan:
        act = partial(_calibrated, start, peak, seed, force)
    if sides[1].table != ALL:
        return act("", sides, target)
    if target is None or CHANNEL not in str(sides[0].path):
        raise CpunetError(
            f"`data_table` {ALL}: each channel is a detector with physics of its own",
            f"give `out`, and the simulation of each as `sim` sims/{CHANNEL}.lh5",
        )
    return each_channel(paired(*sides), target, act)


Start = Callable[[Pair], tuple[Search, InputSet]]


@one_thread_for_matrices()
def _planned(start: Start, force: bool, _name: str, pair: Pair, out: Path | None) -> Plan:
    """Forecast how well the pulses of a channel constrain the physics, before any fit."""
    if out is not None:
        refuse_existing(out, *pair[0].files, *pair[1].files, force=force)
    with stage("Planning") as bar:
        search, _ = start(pair)
        search.simulator.simulated = bar.update
        physics = search.simulator.physics
        bar.total = 2 + 2 * len(physics.nuisances)
        linear = search.plan()
    errors, names = {}, [nuisance.name for nuisance in physics.nuisances]
    for i, (centre, width) in enumerate(zip(*physics.priors(), strict=True)):
        own = partial(physics.in_own_unit, i, float(centre))
        errors[physics.nuisances[i].name] = ExpectedErrors(
            simulated=physics.nominal(physics.nuisances[i]),
            prior=own(width)[1],
            alone={n: own(linear.errors([i], int(n) / 2)[0])[1] for n in PLANNED},
            all_free={n: own(linear.errors(pairs=int(n) / 2)[i])[1] for n in PLANNED},
        )
    plan = Plan(
        detector=physics.detector.name,
        errors_by_name=errors,
        directions={n: linear.directions(names, int(n) / 2) for n in PLANNED},
    )
    if out is not None:
        plan.save(out, force=force)
    return plan


@one_thread_for_matrices()
def _calibrated(
    start: Start, peak: str, seed: int, force: bool, _name: str, pair: Pair, out: Path | None
) -> Calibration:
    """Calibrate detector and readout of a channel together."""
    assert out is not None
    refuse_existing(out, *pair[0].files, *pair[1].files, force=force)
    keep_freed_memory()
    clock, started = time.perf_counter(), datetime.now(UTC)
    search, data = start(pair)
    with folder_written_aside(out, RUN, force=force) as folder:
        with stage("Calibrating", search.simulations) as bar:
            search.simulator.simulated = bar.update
            problem, result = search.run()
        physics = search.simulator.physics
        if (per := result.chi_square.after / problem.moments) > HOPELESS:
            raise CpunetError(
                f"{data.path}: no physics near those of {physics.detector.name} "
                f"make the simulation look like it (chi-square {per:.0f} per function); is it "
                "of another detector, or of other energies (`peak`)?"
            )
        for note in result.notes:
            log.info(titled(note))
        detector, settings = physics.at(problem.coordinates)
        for file, config in ((DETECTOR, detector), (SETTINGS, settings)):
            text = result.comment + yaml_text(config.model_dump(mode="json"))
            (folder / file).write_text(text, encoding="utf-8")
        # all events of the file
        hits, values = HitFile(pair[0].path, placed=True), dict(settings)
        simulate(folder / SIM, detector=detector, hits=hits, settings=values, seed=seed)
        recipe = search.sets.recipe
        selection = parse_selection(peak, recipe.peaks)
        sim = load_pulses(PulseFile(folder / SIM), "simulated", recipe, selection)
        # not stretched: what is off in the drift is for the physics to explain
        training = recipe.training.model_copy(update={"drift_terms": 0})
        recipe = recipe.model_copy(update={"training": training})
        job = TrainingJob(recipe, peak, seed, "cpu", sim, data)
        run = train_chain(job, with_settings(problem.response, deviations=False))
        facts = {
            "sim": run.sim.model_copy(update={"file": str(out / SIM)}),
            "started": started.isoformat(timespec="seconds"),
            "seconds": round(time.perf_counter() - clock, 1),
            "calibration": CALIBRATION,
        }
        run.model_copy(update=facts).write(folder)
        (folder / CALIBRATION).write_text(result.model_dump_json(indent=1) + "\n")
        for file, figure in result.figures.items():
            figure.savefig(folder / f"{file}.png", dpi=DPI)
    return Calibration.load(out)


def _search(
    pair: Pair, *, recipe: Recipe, free: Freedom, peak: str, events: int, seed: int
) -> tuple[Search, InputSet]:
    """Read and prepare both sides, of the simulated side some events: search, and the data."""
    selection = parse_selection(peak, recipe.peaks)
    data = load_pulses(pair[1], "measured", recipe, selection, shorten=True)
    stored = StoredSimulation.read(pair[0].path)
    sim = load_pulses(pair[0], "simulated", data.recipe, selection)
    require_same_sampling(sim, data)
    for note in require_both_sides(sim, data, selection):
        log.warning(note)
    fewest = min(len(sim.prepared), len(data.prepared))
    if fewest < MIN_PULSES:
        raise CpunetError(
            f"{fewest} pulses of {peak} on a side determine neither the physics nor the "
            f"readout, which takes {MIN_PULSES}",
            "give more files, or more energies as `peak`",
        )
    recipe = data.recipe.at(data.dt_ns)
    looked_at, chosen, priors = free
    physics = Physics(stored.detector, stored.settings, looked_at, priors)
    noise, _ = trace_noise(data, recipe.preparation)
    # in random order, so that any first part is a representative sample
    rows = np.random.default_rng(seed).permutation(len(sim.prepared))[:events]
    some, rng = sim.prepared[rows], np.random.default_rng(seed)
    pulses = some.pulses, data.prepared.pulses
    search = Search(
        simulator=Simulator(stored.hits[some.index], physics),
        sets=PulseSets(*pulses, noise, recipe, rng),
        chosen=chosen,
    )
    return search, data
