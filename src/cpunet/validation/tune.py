"""Search for settings of a recipe, scored on held-out pulses of the training's energies.

Optuna proposes settings with Gaussian processes and keeps the trials in a journal in the
output folder.  Every process that is given the same folder works on the same search.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cpunet.errors import CpunetError
from cpunet.outputs import refuse_inputs, written_aside
from cpunet.progress import stage
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import (
    InputSet,
    load_pulses,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.parameters import Values, pulse_parameters
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import ReadOptions, Source
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe, SearchConfig
from cpunet.settings import Set, flat, read_settings, yaml_text
from cpunet.training.job import TrainingJob
from cpunet.training.run import resolve_device
from cpunet.training.unfinished import differences
from cpunet.translation.translator import REN
from cpunet.validation.comparisons import null_distances, resampled_twice, wasserstein
from cpunet.validation.methods import like_data

if TYPE_CHECKING:
    from optuna import Study, Trial

log = logging.getLogger(__name__)

JOURNAL, BEST, TABLE = "journal.log", "best.yaml", "trials.csv"
STARTS = 8  # random trials before the first Gaussian process
SHARE = 0.3  # share of the pulses of each side that is held out
MIN_PULSES = 20  # minimum per side for a distribution
MAX_LOST = 0.01  # share of lost translations: losing bad ones would improve the score
# pulses and their comparison must be the same for all trials, so only these may be tuned
TUNED = ("generator", "discriminator", "training")
UNCHANGED, REASON, BEGUN = "unchanged recipe", "reason", "begun with"  # user attributes


def tune(
    sim: Source,
    data: Source,
    out: str | Path,
    *,
    recipe: str | Path | Recipe = "fast",
    settings: Set = (),
    trials: int = 30,
    peak: str = "FEP",
    seed: int = 0,
    device: str = "auto",
    read: ReadOptions = ReadOptions(),
) -> Study:
    """Search for the settings that translate held-out pulses of the training's energies best.

    Parameters
    ----------
    sim, data, peak, device, read
        See `cpunet.train`.
    out
        Folder of the search, a new one or one to continue: ``best.yaml`` (a recipe),
        ``trials.csv``, and ``journal.log`` with all that Optuna knows.
    recipe, settings
        Recipe with its search space; its own values are the first trial.
    trials
        Total number of trials, including completed and failed ones.
    seed
        Seed of the split into fitted and held-out pulses, of all trainings, and of the search.

    Returns
    -------
    optuna.Study
        Choices of a search space are JSON texts in its trials.

    Raises
    ------
    CpunetError
        If optuna is missing, the search space or the input cannot be used, the folder is not
        that of a search with the same settings and pulses, or no trial has a score.
    """
    try:
        import optuna
        from optuna.storages.journal import JournalFileBackend
    except ImportError as error:
        raise CpunetError(
            "tuning needs optuna, which is not installed; pip install 'cpunet-hpge[tune]'"
        ) from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    out, sides, recipe = Path(out), read.files(sim, data), load_recipe(recipe, settings)
    device, space = resolve_device(device, recipe), search_space(recipe)
    refuse_inputs(out, *sides[0].files, *sides[1].files)
    if out.exists() and not (out / JOURNAL).exists():
        raise CpunetError(f"{out}: exists already and holds no search; choose another name")
    selection = parse_selection(peak, recipe.peaks)
    measured = load_pulses(sides[1], "measured", recipe, selection, shorten=True)
    recipe = measured.recipe  # with windows that the traces contain
    simulated = load_pulses(sides[0], "simulated", recipe, selection)
    require_same_sampling(simulated, measured)
    require_both_sides(simulated, measured, selection)
    held_out = HeldOut.of(simulated, measured, recipe, seed)
    out.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name="cpunet",
        storage=optuna.storages.JournalStorage(JournalFileBackend(str(out / JOURNAL))),
        load_if_exists=True,
    )
    begun = {"recipe": recipe.model_dump(mode="json"), "peak": peak, "seed": seed}
    begun |= {"simulation": simulated.fingerprint(), "data": measured.fingerprint()}
    for difference in differences(study.user_attrs.get(BEGUN, begun), begun):
        raise CpunetError(
            f"{out}: was begun with other settings or pulses: {difference}; give the same, or "
            "choose another name"
        )
    study.set_user_attr(BEGUN, begun)
    own = {key: v for key, v in flat(recipe.model_dump(mode="json")) if key in space}
    given = {key: _in_journal(space[key], value) for key, value in own.items()}
    if not study.trials and None not in given.values():
        study.enqueue_trial(given, {UNCHANGED: True})
    ended = (optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.FAIL)
    with stage("Trials", trials) as bar:
        while (done := len(study.get_trials(states=ended))) < trials:
            bar.update(done - bar.n)
            trial = study.ask()
            # trials have numbers of their own, so processes do not draw the same random ones
            study.sampler = optuna.samplers.GPSampler(
                seed=(seed + trial.number) % 2**32,
                n_startup_trials=STARTS,
                warn_independent_sampling=False,
            )
            values = {key: _suggested(trial, key, own[key], space[key]) for key in space}
            try:
                ren = held_out.train(with_values(recipe, values), seed, device)
                study.tell(trial, held_out.score(ren))
            except CpunetError as error:
                trial.set_user_attr(REASON, str(error))
                log.info(f"trial {trial.number} failed: {error}")
                study.tell(trial, state=ended[1])
        bar.update(done - bar.n)
    _write(out, study, recipe, space)
    return study


def _write(out: Path, study: Study, recipe: Recipe, space: Mapping[str, SearchConfig]) -> None:
    with written_aside(out / TABLE) as aside:
        columns = ("number", "state", "value", "duration", "params", "user_attrs")
        study.trials_dataframe(columns).to_csv(aside, index=False)
    try:
        best = study.best_trial
    except ValueError as error:
        reasons = [t.user_attrs[REASON] for t in study.trials if REASON in t.user_attrs]
        first = next(iter(reasons), "interrupted")
        raise CpunetError(f"{out}: no trial has a score; the first: {first}") from error
    chosen = {k: json.loads(v) for k, v in best.params.items() if space[k].choices is not None}
    description = f"{recipe.description}; tuned, trial {best.number}"
    tuned = with_values(recipe, best.params | chosen).model_copy(
        update={"name": f"{recipe.name}-tuned", "description": description}
    )
    with written_aside(out / BEST) as aside:
        aside.write_text(yaml_text(tuned.model_dump(mode="json")), encoding="utf-8")


def search_space(recipe: Recipe) -> dict[str, SearchConfig]:
    """The search space of a recipe, after checking its keys and values.

    Raises
    ------
    CpunetError
        If there is none, or a key or value is not allowed; the message names the key.
    """
    if not recipe.search:
        raise CpunetError(
            f"recipe {recipe.name}: has no search space; add one, as "
            "search: {training.noise_sets: {choices: [2, 4, 8]}}"
        )
    settings_by_name = dict(flat(recipe.model_dump(mode="json")))
    for key, config in recipe.search.items():
        if key.split(".")[0] not in TUNED:
            raise CpunetError(
                f"recipe {recipe.name}: search.{key}: only settings of {', '.join(TUNED)} "
                "can be tuned"
            )
        if key not in settings_by_name:
            raise CpunetError(f"recipe {recipe.name}: search.{key}: there is no such setting")
        for value in config.choices or (config.low, config.high):
            try:
                with_values(recipe, {key: value})
            except CpunetError as error:
                raise CpunetError(f"recipe {recipe.name}: search.{key}: {error}") from error
    return dict(recipe.search)


def with_values(recipe: Recipe, values: Mapping[str, Any]) -> Recipe:
    """A recipe with other values, and no search space.

    Raises
    ------
    CpunetError
        If a value is not allowed.
    """
    return read_settings(Recipe, recipe, {**values, "search": None})


def _in_journal(config: SearchConfig, value: Any) -> Any:
    """A value as the journal has it, choices as JSON; None if the space does not contain it."""
    if (choices := config.choices) is not None:  # a setting of 4.0 is the choice 4
        return json.dumps(choices[choices.index(value)]) if value in choices else None
    number = isinstance(value, int | float)
    return value if number and config.low <= value <= config.high else None


def _suggested(trial: Trial, key: str, own: Any, config: SearchConfig) -> Any:
    """The value of a setting proposed for a trial; an integer if all that is given is."""
    if config.choices is not None:
        return json.loads(trial.suggest_categorical(key, [*map(json.dumps, config.choices)]))
    ends: Any = config.low, config.high
    if all(type(number) is int for number in (own, *ends)):
        return trial.suggest_int(key, *ends, log=config.log)
    return trial.suggest_float(key, *ends, log=config.log)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Prepared pulses of both sides, split into pulses to fit and held-out ones.

    Parameters
    ----------
    fit_sim, fit_data
        Pulses for the training.
    sim, data
        Held-out pulses.
    values, nulls
        Parameters of the held-out data, and the null distance of each.
    """

    fit_sim: InputSet
    fit_data: InputSet
    sim: Pulses
    data: Pulses
    values: dict[str, Values]
    nulls: dict[str, float]
    seed: int

    @classmethod
    def of(cls, sim: InputSet, data: InputSet, recipe: Recipe, seed: int) -> Self:
        """Split both sides at random.

        Raises
        ------
        CpunetError
            If too few pulses would be held out.
        """
        rng = np.random.default_rng(seed)
        fit_sim, held_sim = _split(sim, rng)
        fit_data, held_data = _split(data, rng)
        values = pulse_parameters(held_data, recipe.preparation, recipe.scores)
        n_sim, n_data = len(held_sim), len(held_data)
        draws = resampled_twice(n_data, n_sim, n_data, recipe.scores.bootstraps, seed)
        nulls = {name: null_distances(v, draws).wasserstein for name, v in values.items()}
        return cls(fit_sim, fit_data, held_sim, held_data, values, nulls, seed)

    def score(self, ren: REN) -> float:
        r"""Distance of translated held-out pulses from data; 1 for two samples of the data.

        .. math:: \frac{1}{n} \sum_{p=1}^{n} \frac{W_1(p)}{\langle W_1(p) \rangle_0}

        over the pulse-shape parameters :math:`p`, with the mean of the null in the
        denominator.

        Raises
        ------
        CpunetError
            If pulses cannot be translated.
        """
        windows = like_data(ren, self.sim, np.random.default_rng(self.seed))
        whole = np.isfinite(windows).all(axis=1)
        if (lost := 1 - whole.mean()) > MAX_LOST:
            raise CpunetError(f"{100 * lost:.0f} % of the held-out pulses have no translation")
        pulses = Pulses.of(windows[whole], dt_ns=self.sim.dt_ns)
        values = pulse_parameters(pulses, ren.recipe.preparation, ren.recipe.scores)
        ratios = [wasserstein(self.values[k], values[k]) / self.nulls[k] for k in values]
        score = float(np.mean(ratios))
        if not np.isfinite(score):
            raise CpunetError("a parameter of the held-out pulses has no value")
        return score

    def train(self, recipe: Recipe, seed: int, device: str) -> REN:
        """Train on the pulses that are not held out; see `cpunet.training.train`.

        Raises
        ------
        CpunetError
            If the training fails.
        """
        whole = recipe.at(self.fit_sim.dt_ns)
        job = TrainingJob(whole, "", seed, device, self.fit_sim, self.fit_data)
        return REN.of(job.trained(), device)


def _split(side: InputSet, rng: np.random.Generator) -> tuple[InputSet, Pulses]:
    """The pulses of a side to fit, and those held out."""
    prepared = side.prepared
    rows, n = rng.permutation(len(prepared)), int(SHARE * len(prepared))
    if n < MIN_PULSES:
        raise CpunetError(
            f"{side.path}: {len(prepared)} pulses, of which {n} would be held out, "
            f"and {MIN_PULSES} are needed; select more energies (`peak`) or give more"
        )
    rest = replace(side, prepared=prepared[np.sort(rows[n:])])
    return rest, prepared.pulses[np.sort(rows[:n])]
