"""Search for settings of a recipe, scored on held-out pulses of the training's energies.

Optuna proposes settings with Gaussian processes.  The trials are stored in a journal in the
folder, so a search can be resumed and shared by several machines.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from cpunet.errors import CpunetError
from cpunet.jobs.common.devices import resolve_device
from cpunet.jobs.common.inputs import InputFile, load_measured, load_simulated
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.common.pool import Link, Outcome, shared_cores, work_off
from cpunet.jobs.studies.fingerprints import fingerprints
from cpunet.jobs.studies.trial_score import HeldOut
from cpunet.jobs.studies.tuning_study import (
    REASON,
    SECONDS,
    WORKER,
    counted,
    found,
    lose,
    open_study,
    queue_first,
    require_optuna,
    suggested,
    this_worker,
)
from cpunet.outputs import FolderKind, written_aside
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.training.ensemble_folder import (
    read_study,
    require_usable,
    working_folder,
    write_json,
)
from cpunet.training.search_space import search_space, with_values

if TYPE_CHECKING:
    from optuna import Study, Trial

QUIET = Monitor()
TRIALS = 30
TUNE, BEST, TABLE = "tune.json", "best.yaml", "trials.csv"
TUNE_KIND = FolderKind(
    name="search",
    command="cpunet tune",
    known_by=TUNE,
    own=r"tune\.json|best\.yaml|trials\.csv|journal\.log.*",
)
STARTS = 8  # random trials before the first Gaussian process


def tune_recipe(
    sim: InputFile,
    data: InputFile,
    out: Path,
    recipe: Recipe,
    *,
    trials: int = TRIALS,
    peak: str = "FEP",
    seed: int = 0,
    jobs: int | None = None,
    threads: int | None = None,
    device: str = "auto",
    resume: bool = False,
    force: bool = False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Search for the settings that translate held-out pulses of the training's energies best.

    Parameters
    ----------
    sim, data, peak, device
        See `cpunet.jobs.training.train.train_run`.
    out
        Folder of the search: ``best.yaml`` (a recipe), ``trials.csv``, ``tune.json``.
    recipe
        Recipe with its search space; its own values are the first trial.
    trials
        Total number of trials, including completed ones.
    seed
        Seed of the split into fitted and held-out pulses, of all trainings, and of the search.
    jobs, threads
        See `cpunet.jobs.studies.ensemble.train_ensemble`.
    resume
        Whether to resume a search, or join it from another machine; all else must be unchanged.
    force
        Whether to replace an existing search, without `resume`.
    monitor
        Receiver of the progress.

    Returns
    -------
    dict
        ``best`` (number, score, values), ``first`` (score of the unchanged recipe, or None),
        ``trials`` (number, state, score, values and reason of each), ``importances``.

    Raises
    ------
    CpunetError
        If optuna is missing, the search space or the input cannot be used, the folder exists
        or was begun with other settings, or no trial has a score.
    """
    require_optuna()
    if trials < 1:
        raise CpunetError(f"--trials {trials}: give 1 or more")
    device, space = resolve_device(device), search_space(recipe)
    require_usable(out, TUNE_KIND, *sim.files, *data.files, resume=resume, force=force)
    begun_with = {"recipe": recipe.model_dump(mode="json"), "peak": peak, "seed": seed}
    begun_with |= fingerprints(sim, data, recipe, peak, monitor)
    with working_folder(out, TUNE_KIND, resume=resume, force=force, alone=False) as folder:
        known = read_study(folder / TUNE, begun_with)
        write_json(folder / TUNE, known or {"begun_with": begun_with})
        study = open_study(folder, recipe)
        queue_first(study, recipe, space)
        left = range(max(0, trials - len(counted(study))))
        jobs, threads = shared_cores(jobs, threads, len(left), device)
        tuner = _Tuner(sim, data, folder, recipe, peak, seed, device, trials)
        outcomes = work_off(tuner, left, jobs=jobs, threads=threads, monitor=monitor)
        title = f"Trials, {jobs} at a time"
        with monitor.stage(title, len(left)) as advance, closing(outcomes):
            for outcome in outcomes:
                if isinstance(outcome, Outcome):
                    advance(1)
                    if outcome.failure is not None:
                        monitor.note(f"warning: a trial was lost: {outcome.failure}")
        told = found(study, recipe, space)
        _write(folder, told, recipe, {"begun_with": begun_with})
    return told


@dataclass(frozen=True)
class _Tuner:
    """The work of each process: one trial after the other."""

    sim: InputFile
    data: InputFile
    folder: Path
    recipe: Recipe
    peak: str
    seed: int
    device: str
    trials: int

    def __call__(self, link: Link) -> Callable[[int], None]:
        """Read the pulses once; return a function that runs a trial."""
        del link
        recipe, quiet = self.recipe, Monitor()
        selection = parse_selection(self.peak, recipe.peaks)
        sim = load_simulated(self.sim, recipe, selection, quiet)
        data = load_measured(self.data, recipe, selection, quiet)
        held_out = HeldOut.of(sim, data, self.data, recipe, self.seed)
        study = open_study(self.folder, recipe)
        return lambda number: self._trial(number, study, held_out)

    def _trial(self, number: int, study: Study, held_out: HeldOut) -> None:
        from optuna import TrialPruned
        from optuna.samplers import GPSampler
        from optuna.trial import TrialState

        before = len(study.trials)
        if len(counted(study)) >= self.trials:
            return  # another machine was faster
        # a seed per trial: a resumed search must not repeat the same random numbers
        mixed = np.random.SeedSequence([self.seed, before, number]).generate_state(1)
        study.sampler = GPSampler(
            seed=int(mixed[0]), n_startup_trials=STARTS, warn_independent_sampling=False
        )
        trial, clock = study.ask(), time.perf_counter()
        trial.set_user_attr(WORKER, this_worker())
        state, score = TrialState.COMPLETE, None
        try:
            score = self._score(trial, held_out)
        except TrialPruned:
            state = TrialState.PRUNED
        except CpunetError as error:
            trial.set_user_attr(REASON, str(error))
            state = TrialState.FAIL
        except BaseException:
            lose(study, trial)
            raise
        trial.set_user_attr(SECONDS, round(time.perf_counter() - clock, 1))
        study.tell(trial, score, state=state)

    def _score(self, trial: Trial, held_out: HeldOut) -> float:
        from optuna import TrialPruned

        space = self.recipe.search or {}
        values = {key: suggested(trial, key, self.recipe, space[key]) for key in space}

        def report(iteration: int, score: float) -> None:
            trial.report(score, iteration)
            if trial.should_prune():
                raise TrialPruned

        recipe = with_values(self.recipe, values)
        return held_out.score(held_out.train(recipe, self.seed, self.device, report))


def _write(folder: Path, told: dict[str, Any], recipe: Recipe, more: dict[str, Any]) -> None:
    best = told["best"]
    tuned = with_values(recipe, best["values"]).model_copy(
        update={
            "name": f"{recipe.name}-tuned",
            "description": f"{recipe.description}; tuned, trial {best['number']}",
        }
    )
    with written_aside(folder / BEST) as aside:
        aside.write_text(yaml.safe_dump(tuned.model_dump(mode="json"), sort_keys=False))
    with written_aside(folder / TABLE) as aside, aside.open("w", newline="") as stream:
        table = csv.writer(stream)
        keys = [*(recipe.search or {})]
        table.writerow(["number", "state", "score", "seconds", *keys, "reason"])
        for row in told["trials"]:
            cells = [row["values"].get(key) for key in keys]
            told_of = [row[name] for name in ("number", "state", "score", "seconds")]
            table.writerow([*told_of, *cells, row["reason"]])
    write_json(folder / TUNE, more | told)
