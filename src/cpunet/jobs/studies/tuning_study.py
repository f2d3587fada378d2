"""The journal of trials: starting, losing and repeating them, and their results."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cpunet.errors import CpunetError
from cpunet.recipes.schema import Recipe, SearchConfig
from cpunet.training.search_space import holds, is_whole, value_of

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.trial import FrozenTrial

JOURNAL = "journal.log"
STUDY = "cpunet"
WARM_UP = 4  # a training is not pruned in its first quarter
# user attributes of a trial, and of the study with the number of a trial
WORKER, REASON, SECONDS, LOST = "worker", "reason", "seconds", "lost"


def require_optuna() -> Any:
    """Import optuna with its log messages silenced.

    Raises
    ------
    CpunetError
        If optuna is not installed.
    """
    try:
        import optuna
    except ImportError as error:
        raise CpunetError(
            "tuning needs optuna, which is not installed; pip install 'cpunet-hpge[tune]'"
        ) from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def open_study(folder: Path, recipe: Recipe) -> Study:
    """Open the study in a folder, or create a new one.

    Raises
    ------
    CpunetError
        If its journal cannot be read: it was damaged, or its last line cut off by a full disk.
    """
    optuna = require_optuna()
    from optuna.storages.journal import JournalFileBackend

    journal = folder / JOURNAL
    try:
        study: Study = optuna.create_study(
            study_name=STUDY,
            storage=optuna.storages.JournalStorage(JournalFileBackend(str(journal))),
            pruner=optuna.pruners.MedianPruner(
                n_startup_trials=4, n_warmup_steps=recipe.training.iterations // WARM_UP
            ),
            load_if_exists=True,
        )
        _ = study.trials
    except OSError:
        raise
    except Exception as error:  # optuna executes the lines of a journal unchecked
        raise CpunetError(
            f"{journal}: is damaged ({type(error).__name__}); remove its damaged lines, or "
            "begin again with --force"
        ) from error
    return study


def queue_first(study: Study, recipe: Recipe, space: Mapping[str, SearchConfig]) -> None:
    """Queue the unchanged recipe and the unfinished trials of processes that have ended."""
    from optuna.trial import TrialState

    if not study.trials:
        own = {key: value_of(recipe, key) for key in space}
        if all(holds(config, own[key]) for key, config in space.items()):
            study.enqueue_trial(_labelled(own, space))
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        if _is_gone(str(trial.user_attrs.get(WORKER, ""))):
            lose(study, trial)


def this_worker() -> str:
    """Name of this process: machine and process number."""
    return f"{socket.gethostname()}:{os.getpid()}"


def lose(study: Study, trial: FrozenTrial | Trial) -> None:
    """Mark an interrupted trial as lost and queue it again."""
    from optuna.trial import TrialState

    study.set_user_attr(f"{LOST} {trial.number}", True)
    study.tell(trial.number, state=TrialState.FAIL)
    # a trial that was queued has all values before it has suggested any
    queued = study.trials[trial.number].system_attrs.get("fixed_params", {})
    if params := {**queued, **trial.params}:
        study.enqueue_trial(params)


def _is_gone(worker: str) -> bool:
    """Whether a process of this machine has ended; False for other machines."""
    host, _, pid = worker.rpartition(":")
    if host != socket.gethostname():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return _is_zombie(int(pid))


def _is_zombie(pid: int) -> bool:
    """Whether a process has ended without being waited for, as in many containers."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (OSError, IndexError):
        return False


def counted(study: Study) -> list[FrozenTrial]:
    """Trials that were started and not lost."""
    from optuna.trial import TrialState

    begun = (t for t in study.trials if t.state != TrialState.WAITING)
    lost = study.user_attrs
    return [trial for trial in begun if f"{LOST} {trial.number}" not in lost]


def suggested(trial: Trial, key: str, recipe: Recipe, config: SearchConfig) -> Any:
    """The value of a setting proposed for a trial."""
    if config.choices is not None:
        labels = [json.dumps(choice) for choice in config.choices]
        return json.loads(str(trial.suggest_categorical(key, labels)))
    low, high = config.low, config.high
    assert low is not None
    assert high is not None
    if is_whole(recipe, key, config):
        return trial.suggest_int(key, int(low), int(high), log=config.log)
    return trial.suggest_float(key, low, high, log=config.log)


def _labelled(values: Mapping[str, Any], space: Mapping[str, SearchConfig]) -> dict[str, Any]:
    """Values in the form of the journal: choices as text, since they can be lists."""
    labelled = dict(values)
    for key, config in space.items():
        if config.choices is not None:  # a setting of 4.0 is the choice 4 of the search space
            labelled[key] = json.dumps(config.choices[config.choices.index(values[key])])
    return labelled


def _plain(params: Mapping[str, Any], space: Mapping[str, SearchConfig]) -> dict[str, Any]:
    return {k: v if space[k].choices is None else json.loads(v) for k, v in params.items()}


def found(study: Study, recipe: Recipe, space: Mapping[str, SearchConfig]) -> dict[str, Any]:
    """Results of the trials, ready for JSON; see `cpunet.jobs.studies.tune.tune_recipe`.

    Raises
    ------
    CpunetError
        If no trial has a score.
    """
    rows: list[dict[str, Any]] = [
        {
            "number": trial.number,
            "state": trial.state.name.lower(),
            "score": trial.value,
            "values": _plain(trial.params, space),
            "seconds": trial.user_attrs.get(SECONDS),
            "reason": trial.user_attrs.get(REASON),
        }
        for trial in counted(study)
    ]
    scored = [row for row in rows if row["state"] == "complete"]  # pruned ones also have scores
    if not scored:
        reason = next((row["reason"] for row in rows if row["reason"]), "none was completed")
        raise CpunetError(f"none of {len(rows)} trials has a score; the first: {reason}")
    own = {key: value_of(recipe, key) for key in space}
    optuna = require_optuna()
    importances: dict[str, float] = {}
    if len(scored) > 1:
        with suppress(ValueError, RuntimeError):  # too few trials, or all equal
            importances = optuna.importance.get_param_importances(
                study, evaluator=optuna.importance.PedAnovaImportanceEvaluator()
            )
    return {
        "best": min(scored, key=lambda row: row["score"]),
        "first": next((row["score"] for row in scored if row["values"] == own), None),
        "trials": rows,
        "importances": importances,
    }
