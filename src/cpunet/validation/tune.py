"""Search for settings of a recipe, scored on held-out pulses of the training's energies.

Optuna proposes settings with Gaussian processes and keeps the trials in a journal in the
output folder.  Every process that is given the same folder works on the same search.
"""

from __future__ import annotations

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
from cpunet.pulses.parameters import Values, pulse_parameters
from cpunet.pulses.reading.files import ReadOptions, Source
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.settings import flat, read_settings, yaml_text
from cpunet.training.job import TrainingJob
from cpunet.training.run import resolve_device
from cpunet.training.unfinished import differences
from cpunet.translation.translator import REN
from cpunet.validation.comparisons import NULL_NODES, Resampled, drawn_distances, wasserstein
from cpunet.validation.methods import like_data

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution

log = logging.getLogger(__name__)

JOURNAL, BEST = "journal.log", "best.yaml"
STARTS = 8  # random trials before the first Gaussian process
SHARE = 0.3  # share of the pulses of each side that is held out
MIN_PULSES = 20  # minimum per side for a distribution
MAX_LOST = 0.01  # share of lost translations: losing bad ones would improve the score
# pulses and their comparison must be the same for all trials, so only these may be tuned
TUNED = ("generator", "discriminator", "training")
REASON, BEGUN = "reason", "begun with"  # user attributes


def tune(
    sim: Source,
    data: Source,
    out: str | Path,
    space: Mapping[str, BaseDistribution],
    *,
    recipe: str | Path | Recipe = "fast",
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
        Folder of the search, a new one or one to continue: ``best.yaml`` (a recipe), and
        ``journal.log`` with all that Optuna knows.
    space
        Distributions of Optuna by setting, as
        ``{"training.level_ns": FloatDistribution(100, 2000, log=True)}``.
    recipe
        Name, file or recipe; if the space has its own values, they are the first trial.
    trials
        Total number of trials, including completed and failed ones.
    seed
        Seed of the split into fitted and held-out pulses, of all trainings, and of the search.

    Returns
    -------
    optuna.Study
        With all trials.

    Raises
    ------
    CpunetError
        If optuna is missing, the search space or the input cannot be used, the folder is not
        that of a search with the same settings and pulses, or no trial has a score.
    """
    try:
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend
    except ImportError as error:
        raise CpunetError(
            "tuning needs optuna, which is not installed; pip install 'cpunet-hpge[tune]'"
        ) from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    out, pair, recipe = Path(out), read.files(sim, data), load_recipe(recipe)
    own = own_values(recipe, space)
    refuse_inputs(out, *pair[0].files, *pair[1].files)
    if out.exists() and not (out / JOURNAL).exists():
        raise CpunetError(f"{out}: exists already and holds no search; choose another name")
    device = resolve_device(device, recipe)
    job = TrainingJob.of(pair, recipe, peak, seed=seed, device=device)
    held_out, recipe = HeldOut.of(job), job.data.recipe  # with windows that traces contain
    out.mkdir(parents=True, exist_ok=True)
    begun = {"recipe": recipe.model_dump(mode="json"), "peak": peak, "seed": seed}
    begun |= {"space": {key: str(of) for key, of in space.items()}}
    begun |= {"simulation": job.sim.fingerprint(), "data": job.data.fingerprint()}
    storage = JournalStorage(JournalFileBackend(str(out / JOURNAL)))
    study = optuna.create_study(study_name="cpunet", storage=storage, load_if_exists=True)
    for difference in differences(study.user_attrs.get(BEGUN, begun), begun):
        text = f"{out}: was begun with other settings or pulses: {difference}"
        raise CpunetError(text, "give the same, or choose another name")
    study.set_user_attr(BEGUN, begun)
    if own and not study.trials:
        study.enqueue_trial(own)
    ended = (optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.FAIL)
    with stage("Trials", trials) as bar:
        while (done := len(study.get_trials(states=ended))) < trials:
            bar.update(done - bar.n)
            # processes that share a search draw other random settings
            own_seed = (seed + len(study.trials)) % 2**32
            study.sampler = optuna.samplers.GPSampler(
                seed=own_seed, n_startup_trials=STARTS, warn_independent_sampling=False
            )
            trial = study.ask(dict(space))
            try:
                ren = held_out.train(read_settings(Recipe, recipe, trial.params))
                study.tell(trial, held_out.score(ren))
            except CpunetError as error:
                trial.set_user_attr(REASON, str(error))
                log.info(f"trial {trial.number} failed: {error}")
                study.tell(trial, state=ended[1])
        bar.update(done - bar.n)
    _write_best(out, study, recipe)
    return study


def _write_best(out: Path, study: Study, recipe: Recipe) -> None:
    """Write the recipe of the best trial."""
    if all(trial.value is None for trial in study.trials):
        reasons = (t.user_attrs[REASON] for t in study.trials if REASON in t.user_attrs)
        first = next(reasons, "interrupted")
        raise CpunetError(f"{out}: no trial has a score; the first: {first}")
    best = study.best_trial
    description = f"{recipe.description}; tuned, trial {best.number}"
    named = {"name": f"{recipe.name}-tuned", "description": description}
    tuned = read_settings(Recipe, recipe, best.params).model_copy(update=named)
    with written_aside(out / BEST) as aside:
        aside.write_text(yaml_text(tuned.model_dump(mode="json")), encoding="utf-8")


def own_values(recipe: Recipe, space: Mapping[str, Any]) -> dict[str, Any]:
    """The recipe's own values of a search space, which is checked; empty if it lacks a value.

    Raises
    ------
    CpunetError
        If a setting or value is not allowed; the message names the setting.
    """
    if not space:
        raise CpunetError("the search space is empty; give some settings in `space`")
    values, own = dict(flat(recipe.model_dump(mode="json"))), {}
    for key, of in space.items():
        if key.split(".")[0] not in TUNED:
            raise CpunetError(f"space: {key}: only settings of {', '.join(TUNED)} can be tuned")
        if key not in values:
            raise CpunetError(f"space: {key}: there is no such setting")
        ends = of.choices if hasattr(of, "choices") else (of.low, of.high)
        for value in ends:
            try:
                read_settings(Recipe, recipe, {key: value})
            except CpunetError as error:
                raise CpunetError(f"space: {error}") from error
        if values[key] in ends or (hasattr(of, "low") and of.low <= values[key] <= of.high):
            own[key] = values[key]
    return own if len(own) == len(space) else {}


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Prepared pulses of both sides, split into pulses to fit and held-out ones.

    Parameters
    ----------
    job
        Training on the pulses to fit.
    sim, data
        Held-out pulses.
    values, nulls
        Parameters of the held-out data, and the null distance of each.
    """

    job: TrainingJob
    sim: Pulses
    data: Pulses
    values: dict[str, Values]
    nulls: dict[str, float]

    @classmethod
    def of(cls, job: TrainingJob) -> Self:
        """Split both sides at random.

        Raises
        ------
        CpunetError
            If too few pulses would be held out.
        """
        rng, fitted, held = np.random.default_rng(job.seed), [], []
        for side in (job.sim, job.data):
            prepared = side.prepared
            rows, n = rng.permutation(len(prepared)), int(SHARE * len(prepared))
            if n < MIN_PULSES:
                raise CpunetError(
                    f"{side.path}: {len(prepared)} pulses, of which {n} would be held out, and "
                    f"{MIN_PULSES} are needed; select more energies (`peak`) or give more"
                )
            fitted.append(replace(side, prepared=prepared[np.sort(rows[n:])]))
            held.append(prepared.pulses[np.sort(rows[:n])])
        # what the continuum has is not held out
        job = replace(job, peak="", sim=fitted[0], data=fitted[1], continuum=None)
        values = pulse_parameters(held[1], job.recipe.preparation, job.recipe.scores)
        rng, sizes = np.random.default_rng(job.seed), [len(pulses) for pulses in held]
        draws = [Resampled(sizes[1], n, job.recipe.scores.bootstraps, rng) for n in sizes]
        nulls = {k: drawn_distances(v, v, draws, NULL_NODES).mean() for k, v in values.items()}
        return cls(job, held[0], held[1], values, nulls)

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
        windows = like_data(ren, self.sim, np.random.default_rng(self.job.seed))
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

    def train(self, recipe: Recipe) -> REN:
        """Train on the pulses that are not held out; see `cpunet.training.train`."""
        job = replace(self.job, recipe=recipe.at(self.job.sim.dt_ns))
        return REN.of(job.trained(), job.device)
