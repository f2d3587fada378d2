"""Training by a fit of a readout chain to data."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.jobs.training.chain_and_inverse import known_response, match
from cpunet.jobs.training.training_job import Trained, TrainingJob, TrainOptions
from cpunet.networks.response_layer import Readout
from cpunet.outputs import folder_written_aside
from cpunet.progress import stage
from cpunet.recipes.schema import Recipe
from cpunet.training.loop import Record
from cpunet.training.run_folder import RUN, append_losses


class ResponseTrainer:
    """Fits a readout chain; see `cpunet.jobs.training.trainers.Trainer`."""

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
    ) -> Trained:
        """Fit a readout chain, starting from that of ``init`` or from `known`, if given."""
        started, clock = datetime.now(UTC), time.perf_counter()
        if job.options.init is not None:
            known = known_response(job.options.init, job.data.dt_ns, self.recipe)
        with stage("Matching") as bar:  # how many steps a fit needs is not known

            def listen(step: int, chi_square: float) -> None:
                losses = {"chi_square": chi_square}
                record: Record = {"iteration": step, "rate": 0.0, "losses": losses}
                append_losses(job.folder, [record])
                bar.update(1)
                bar.set_postfix_str(f"chi-square {chi_square:.4g}", refresh=False)

            found = match(job.sides, self.recipe, job.options.seed, listen, known)
        found.log()
        seconds = time.perf_counter() - clock
        info = job.info(started.isoformat(timespec="seconds"), seconds)
        return Trained(found.model, info | {"fit": found.told}, found.recipe)
