"""One training per seed, several in parallel; a failed seed does not stop the others."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cpunet.analysis.seed_scores import failed_seeds, seed_table
from cpunet.errors import CpunetError
from cpunet.jobs.common.devices import resolve_device
from cpunet.jobs.common.inputs import InputFile
from cpunet.jobs.common.monitor import Advance, Monitor
from cpunet.jobs.common.pool import Link, Outcome, shared_cores, work_off
from cpunet.jobs.studies.fingerprints import fingerprints
from cpunet.jobs.training.train import train_run
from cpunet.jobs.training.trainers import trainer_for
from cpunet.jobs.training.training_job import TrainOptions
from cpunet.outputs import written_aside
from cpunet.recipes.schema import Recipe
from cpunet.training.ensemble_folder import (
    ENSEMBLE,
    ENSEMBLE_KIND,
    member_folder,
    read_json,
    read_study,
    require_usable,
    working_folder,
    write_json,
)
from cpunet.training.run_folder import INFO, read_info
from cpunet.training.unfinished import unfinished_name

QUIET = Monitor()
SEEDS = 20
FIGURE, DPI = "seeds.png", 150
METRICS = "metrics.json"
TRAINED, FAILED = "trained", "failed"


def train_ensemble(
    sim: InputFile,
    data: InputFile,
    out: Path,
    recipe: Recipe,
    *,
    seeds: int = SEEDS,
    peak: str = "FEP",
    jobs: int | None = None,
    threads: int | None = None,
    validate: bool = True,
    truth: Path | None = None,
    device: str = "auto",
    resume: bool = False,
    force: bool = False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Train the seeds 0 … N - 1, each in its own run folder, and score them.

    Parameters
    ----------
    sim, data, recipe, peak, device
        See `cpunet.jobs.training.train.train_run`.
    out
        Folder of the run folders; an interrupted job can be resumed.
    seeds
        Number of seeds.
    jobs
        Number of parallel processes; by default one per core, or one on a GPU.
    threads
        CPU threads per process; by default its share of the cores.
    validate
        Whether to score each seed on all peaks, without baseline methods.
    truth
        See `cpunet.jobs.validation.validate.validate_run`.
    resume
        Whether to resume: finished seeds are kept, unfinished and failed ones are trained.
        The number of seeds can be increased; everything else must be unchanged.
    force
        Whether to replace an existing ensemble, without `resume`.
    monitor
        Receiver of the progress.

    Returns
    -------
    dict
        Content of ``ensemble.json``.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists or was begun with other settings, or
        every seed failed.
    """
    if seeds < 1:
        raise CpunetError(f"--seeds {seeds}: give 1 or more")
    device = resolve_device(device)
    require_usable(
        out, ENSEMBLE_KIND, *sim.files, *data.files, truth, resume=resume, force=force
    )
    begun_with = {"recipe": recipe.model_dump(mode="json"), "peak": peak}
    begun_with |= fingerprints(sim, data, recipe, peak, monitor)
    with working_folder(out, ENSEMBLE_KIND, resume=resume, force=force) as folder:
        ensemble = _Ensemble(folder, begun_with)
        member = _Member(sim, data, folder, recipe, peak, validate, truth, device)
        left = [seed for seed in range(seeds) if not member.is_done(seed)]
        ensemble.complete({*range(seeds)} - {*left})
        jobs, threads = shared_cores(jobs, threads, len(left), device)
        _remove_leavings(folder)
        outcomes = work_off(member, left, jobs=jobs, threads=threads, monitor=monitor)
        title = f"Training {len(left)} seeds, {jobs} at a time"
        with _stage(monitor, title, len(left), recipe) as count, closing(outcomes):
            for outcome in outcomes:
                count(outcome)
                if isinstance(outcome, Outcome):
                    ensemble.add(outcome)
                    if outcome.failure is not None:
                        monitor.note(f"seed {outcome.item} failed: {outcome.failure}")
        return ensemble.finish()


class _Ensemble:
    """``ensemble.json``: state and results of each seed."""

    def __init__(self, folder: Path, begun_with: dict[str, Any]) -> None:
        self.folder, self.path = folder, folder / ENSEMBLE
        content = read_study(self.path, begun_with) or {"begun_with": begun_with}
        content.setdefault("seeds", {})
        self.content = content
        for seed, entry in [*content["seeds"].items()]:
            if entry["state"] == FAILED:  # failed seeds are retried
                del content["seeds"][seed]
        self._write()

    def add(self, outcome: Outcome) -> None:
        """Record the outcome of a seed."""
        entry = {"state": FAILED, "reason": outcome.failure}
        if outcome.failure is None:
            entry = {"state": TRAINED} | outcome.result
        self.content["seeds"][str(outcome.item)] = entry
        self._write()

    def complete(self, finished: Iterable[int]) -> None:
        """Record finished seeds that are not recorded, since the program was stopped before."""
        for seed in finished:
            if str(seed) not in self.content["seeds"]:
                self.add(Outcome(seed, _results(member_folder(self.folder, seed))))

    def finish(self) -> dict[str, Any]:
        """Combine the scores; return the content of ``ensemble.json``."""
        seeds: dict[str, Any] = self.content["seeds"]
        seeds = dict(sorted(seeds.items(), key=lambda item: int(item[0])))
        failed = {int(s): e["reason"] for s, e in seeds.items() if e["state"] == FAILED}
        metrics = {}
        for seed in (int(s) for s in seeds if int(s) not in failed):
            read = read_json(member_folder(self.folder, seed) / METRICS)
            if read is not None:
                metrics[seed] = read
        self.content |= {"seeds": seeds, "failures": failed, "table": []}
        poor: dict[int, list[str]] = {}
        if metrics:
            self.content["table"] = seed_table(metrics)
            poor = failed_seeds(metrics)
            _draw(self.folder / FIGURE, [*metrics.values()])
        self.content["poor"] = poor
        self.content["failure_rate"] = len({*failed, *poor}) / len(seeds)
        self._write()
        if len(failed) == len(seeds):
            raise CpunetError(
                f"{self.folder}: all of {len(seeds)} seeds failed, the first: "
                f"{next(iter(failed.values()))}"
            )
        return self.content

    def _write(self) -> None:
        write_json(self.path, self.content)


@dataclass(frozen=True)
class _Member:
    """The work of each process: train and score a seed."""

    sim: InputFile
    data: InputFile
    folder: Path
    recipe: Recipe
    peak: str
    validate: bool
    truth: Path | None
    device: str

    def is_done(self, seed: int) -> bool:
        """Whether a seed is finished."""
        run = member_folder(self.folder, seed)
        return (run / INFO).is_file() and (not self.validate or (run / METRICS).is_file())

    def __call__(self, link: Link) -> Callable[[int], dict[str, Any]]:
        """Return a function that processes a seed and returns its times and scores."""
        return lambda seed: self._do(seed, link)

    def _do(self, seed: int, link: Link) -> dict[str, Any]:
        run = member_folder(self.folder, seed)
        if not (run / INFO).is_file():
            self._train(run, seed, link)
        scoring = {}
        if self.validate and not (run / METRICS).is_file():
            clock = time.perf_counter()
            self._score(run)
            scoring = {"seconds_scoring": round(time.perf_counter() - clock, 1)}
        return scoring | _results(run)

    def _train(self, run: Path, seed: int, link: Link) -> None:
        begun = unfinished_name(run).exists()
        with link.stoppable() as stop:
            train_run(
                self.sim,
                self.data,
                run,
                self.recipe,
                TrainOptions(
                    self.peak,
                    seed,
                    self.device,
                    resume=begun and trainer_for(self.recipe).resumable,
                ),
                stop=stop,
                monitor=_Forwarding(link, seed),
            )

    def _score(self, run: Path) -> None:
        # takes seconds to import in each process: only if needed
        from cpunet.jobs.validation.evaluation import ValidateOptions, evaluate

        # the same noise and bootstraps for all: they differ only in the training
        how = ValidateOptions(self.truth, baselines=False, seed=0, device=self.device)
        metrics = evaluate(run, self.sim, self.data, how, QUIET).metrics
        write_json(run / METRICS, metrics)


def _results(run: Path) -> dict[str, Any]:
    """Time of the training and, if the seed was scored, IoU by peak and parameter."""
    results: dict[str, Any] = {"seconds": read_info(run)["seconds"]}
    metrics = read_json(run / METRICS)
    if metrics is not None:
        results["iou"] = {
            peak: {
                name: found["iou"].get("ren") for name, found in of_peak["parameters"].items()
            }
            for peak, of_peak in metrics["peaks"].items()
        }
    return results


class _Forwarding(Monitor):
    """Forwards steps of a training and warnings to the parent process."""

    def __init__(self, link: Link, seed: int) -> None:
        self._link, self._seed = link, seed

    @contextmanager
    def stage(self, title: str, total: int | None = None) -> Iterator[Advance]:
        """Forward the iterations of a CycleGAN."""
        yield self._link.advance if title == "Training" else lambda _steps: None

    def note(self, message: str) -> None:
        """Forward warnings; all other notes are the same for all seeds."""
        if message.startswith("warning"):
            self._link.note(f"seed {self._seed}: {message}")


@contextmanager
def _stage(
    monitor: Monitor, title: str, seeds: int, recipe: Recipe
) -> Iterator[Callable[[Outcome | int], None]]:
    """Count the iterations of a CycleGAN, or seeds for a fit, whose length is unknown.

    A seed that ends early or fails counts as complete.
    """
    each = trainer_for(recipe).steps
    ended = counted = 0
    with monitor.stage(title, seeds * each) as advance:

        def count(outcome: Outcome | int) -> None:
            nonlocal ended, counted
            steps = outcome if isinstance(outcome, int) else 0
            ended += not isinstance(outcome, int)
            steps = max(steps, ended * each - counted)
            counted += steps
            if steps:
                advance(steps)

        yield count


def _draw(path: Path, metrics: list[dict[str, Any]]) -> None:
    from cpunet.analysis.seed_figure import seed_distributions, seed_figure

    with written_aside(path) as aside:
        figure = seed_figure(seed_distributions(metrics))
        figure.savefig(aside, format="png", dpi=DPI)


def _remove_leavings(folder: Path) -> None:
    """Remove temporary files of killed processes."""
    for path in folder.glob(".seed_*"):
        shutil.rmtree(path, ignore_errors=True)
