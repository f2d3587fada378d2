"""Training by a fit of a readout chain to data."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.jobs.training.chain_and_inverse import known_response, match
from cpunet.jobs.training.training_job import TrainingJob, TrainOptions
from cpunet.networks.response_layer import Readout
from cpunet.outputs import folder_written_aside
from cpunet.recipes.schema import Recipe
from cpunet.training.loop import Record
from cpunet.training.run import RUN, Run, append_losses


class ResponseTrainer:
    """Fits a readout chain; see `cpunet.jobs.training.train.TRAINERS`."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe

    def workplace(
        self,
        out: Path,
        read: Sequence[Path | str | None],
        options: TrainOptions,
    ) -> AbstractContextManager[Path]:
        """Context of a folder that appears when the fit is complete."""
        if options.resume:
            raise CpunetError(
                f"recipe {self.recipe.name}: takes a minute and keeps no checkpoints; give the "
                "recipe that the training was begun with, or leave out --resume"
            )
        return folder_written_aside(out, RUN, *read, force=options.force)

    def train(
        self,
        job: TrainingJob,
        known: Readout | None = None,
    ) -> Run:
        """Fit a readout chain, starting from that of ``init`` or from `known`, if given."""
        started, clock = datetime.now(UTC), time.perf_counter()
        if job.init is not None:
            known = known_response(job.init, self.recipe)
        # upper limit for one start; most fits need fewer steps
        steps = self.recipe.matching.training.steps
        with job.monitor.stage("Matching", steps) as advance:

            def listen(step: int, chi_square: float) -> None:
                losses = {"chi_square": chi_square}
                record: Record = {"iteration": step, "rate": 0.0, "losses": losses}
                append_losses(job.folder, [record])
                advance(1)
                job.monitor.state(f"chi-square {chi_square:.4g}")

            model, fit, recipe = match(
                job.sides, self.recipe, job.options.seed, listen, job.monitor, known
            )
        seconds = time.perf_counter() - clock
        began = started.isoformat(timespec="seconds")
        return job.run(model, recipe, began, seconds, fit=fit)
