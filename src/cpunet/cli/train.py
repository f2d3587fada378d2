"""``cpunet train``."""

from __future__ import annotations

import logging
import shlex
import signal
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Self

import typer

from cpunet.cli import options
from cpunet.cli.channels import tell_channels
from cpunet.cli.messages import fail, tell
from cpunet.outputs import refuse_inputs

if TYPE_CHECKING:
    from cpunet.training.run import Run

log = logging.getLogger(__name__)

Out = Annotated[Path, typer.Option("--out", help="Run folder to make.")]
Resume = Annotated[
    bool,
    typer.Option("--resume", help="Resume OUT.unfinished; give all other options as before."),
]
Init = Annotated[
    Path | None,
    typer.Option(help="Run of the same kind to start from, as of another detector or period."),
]


@options.grouped
def train(
    *,
    sim: options.Sim,
    data: options.Data,
    out_folder: Out,
    on: options.TrainOn,
    seed: options.Seed = 0,
    read_as: options.ReadAsOrAll,
    threads: options.Threads = None,
    device: options.Device = "auto",
    init: Init = None,
    resume: Resume = False,
    force: options.Force = False,
) -> None:
    """Train REN and IREN on simulated and measured pulses, unpaired.

    Example: cpunet train --sim sim.lh5 --data raw.lh5 --out run

    Example: cpunet train --recipe paper --sim sim.lh5 --data raw.lh5 --out run --resume

    Example: cpunet train --sim sim.lh5 --data raw.lh5 --data-table all --out runs
    """
    from cpunet.jobs.training.train import train_run
    from cpunet.jobs.training.train_channels import train_channels
    from cpunet.jobs.training.training_job import TrainOptions
    from cpunet.kernels import use_threads
    from cpunet.pulses.channels import ALL, Outcome
    from cpunet.training.loop import StoppedError

    refuse_inputs(out_folder, on.recipe)
    if threads is not None:
        use_threads(threads)
    chosen = on.load()
    every = read_as.data_table == ALL
    work = train_channels if every else train_run
    with _StopRequest() as stop:
        try:
            told = work(
                read_as.sim(sim),
                read_as.data(data),
                out_folder,
                chosen,
                TrainOptions(on.peak, seed, device, init, resume, force),
                stop=stop,
            )
        except StoppedError as stopped:
            fail(str(stopped))
            raise typer.Exit(128 + stop.signal) from None
    if isinstance(told, Outcome):
        tell_channels(told, out_folder, _in_words)
    else:
        tell(f"{out_folder}: {_in_words(told)}")
    words = ["cpunet", "validate", out_folder, "--sim", sim, "--data", data, "--out"]
    report = out_folder.with_name(f"{out_folder.name}-report")
    of_all = ["--data-table", ALL] if every else []
    log.info(f"next: {shlex.join(map(str, [*words, report, *of_all]))}")


def _in_words(run: Run) -> str:
    return f"trained in {run.seconds:.0f} s on {run.device}"


class _StopRequest:
    """Ctrl-C and batch systems stop a training between two iterations, with its state stored.

    A second signal, or one before anyone asks whether to stop, acts as it did before.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._asked = False
        self._before: dict[int, signal._HANDLER] = {}

    def __call__(self) -> bool:
        """Whether to stop."""
        self._asked = True
        return self.signal != 0

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, number: int, _frame: FrameType | None) -> None:
        self.__exit__()
        if not self._asked:
            signal.raise_signal(number)
            return
        self.signal = number
        log.info("stopping after this iteration; once more to stop at once")
