"""Training by a fit of a readout chain to data."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from cpunet.networks.response_layer import Readout
from cpunet.progress import stage
from cpunet.training.fit import known_response, match
from cpunet.training.loop import Record
from cpunet.training.run import Run, append_losses

if TYPE_CHECKING:
    from cpunet.training.job import TrainingJob


def train_chain(job: TrainingJob, known: Readout | None = None) -> Run:
    """Fit a readout chain, starting from that of ``init`` or from `known`, if given."""
    started, clock = datetime.now(UTC), time.perf_counter()
    if job.init is not None:
        known = known_response(job.init, job.recipe)
    with stage("Matching") as bar:  # how many steps a fit needs is not known

        def listen(step: int, chi_square: float) -> None:
            losses = {"chi_square": chi_square}
            record: Record = {"iteration": step, "rate": 0.0, "losses": losses}
            append_losses(job.folder, [record])
            bar.update(1)
            bar.set_postfix_str(f"chi-square {chi_square:.4g}", refresh=False)

        found = match(job.sim, job.data, job.recipe, job.seed, listen, known, job.continuum)
    found.log()
    seconds = time.perf_counter() - clock
    began = started.isoformat(timespec="seconds")
    return job.run(found.model, found.recipe, began, seconds, fit=found.info)
