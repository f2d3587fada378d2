"""Two files in, a run folder with trained networks out."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from torch import nn

from cpunet.errors import CpunetError
from cpunet.files import folder_written_aside
from cpunet.jobs.inputs import InputFile, load_measured, load_simulated, require_same_sampling
from cpunet.jobs.matching import Sides, match
from cpunet.jobs.monitor import Monitor
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import MatchingConfig, Recipe
from cpunet.training.loop import Record, train
from cpunet.training.run_folder import INFO, append_losses, versions, write_run
from cpunet.training.tensorboard import LossBoard

QUIET = Monitor()


def train_run(
    sim: InputFile,
    data: InputFile,
    out: Path,
    recipe: Recipe,
    *,
    peak: str = "FEP",
    seed: int = 0,
    device: str = "auto",
    force: bool = False,
    tensorboard: bool = False,
    monitor: Monitor = QUIET,
) -> dict[str, Any]:
    """Train REN and IREN on the pulses of a peak and write the run folder.

    Parameters
    ----------
    sim, data
        Simulated and measured pulses.
    out
        The run folder; it appears when the training is done.
    recipe
        All settings.
    peak
        Energies to train on: a peak of the recipe or a range in keV.
    seed
        Of everything random.
    device
        ``"cpu"``, ``"cuda"``, or ``"auto"`` for the GPU if there is one.
    force
        Replace an existing folder.
    tensorboard
        Write TensorBoard logs beside the losses (needs the extra ``tensorboard``).
    monitor
        Told of the progress.

    Returns
    -------
    dict
        The content of ``run.json``.

    Raises
    ------
    CpunetError
        If the input cannot be used, the folder exists, or the training diverges.
    """
    device = resolve_device(device)
    selection = parse_selection(peak, recipe.peaks)
    with folder_written_aside(out, marker=INFO, force=force) as folder:
        sim_set = load_simulated(sim, recipe, selection, monitor)
        data_set = load_measured(data, recipe, selection, monitor)
        require_same_sampling(sim_set, data_set)
        started = datetime.now(UTC)
        clock = time.perf_counter()
        board = LossBoard(folder) if tensorboard else None
        sides = Sides(sim_set.prepared.pulses, data_set.prepared.pulses, data)
        matched = isinstance(recipe.training, MatchingConfig)
        stage = "Matching" if matched else "Training"
        with monitor.stage(stage, recipe.training.iterations) as advance:

            def listen(records: list[Record]) -> None:
                append_losses(folder, records)
                if board is not None:
                    board.add(records)
                advance(len(records))

            if matched:
                model, more = match(sides, recipe, seed, listen, monitor)
            else:
                model, more = _train_networks(sides, recipe, seed, device, listen)
        if board is not None:
            board.close()
        info = {
            "recipe": recipe.name,
            "peak": peak,
            "seed": seed,
            "device": device,
            "threads": torch.get_num_threads(),
            "started": started.isoformat(timespec="seconds"),
            "seconds": round(time.perf_counter() - clock, 1),
            "dt_ns": data_set.dt_ns,
            "versions": versions(),
            "sim": sim_set.provenance(),
            "data": data_set.provenance(),
        } | more
        write_run(folder, model, recipe, info)
    return info


def _train_networks(
    sides: Sides,
    recipe: Recipe,
    seed: int,
    device: str,
    listen: Callable[[list[Record]], None],
) -> tuple[nn.Module, dict[str, Any]]:
    model = train(
        sides.sim.waveforms,
        sides.data.waveforms,
        recipe,
        seed=seed,
        device=device,
        listener=listen,
    )
    return model, {}


def resolve_device(device: str) -> str:
    """Turn ``"auto"`` into a device; refuse one that is not there."""
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise CpunetError("no GPU was found; use --device cpu or install a CUDA build of torch")
    if device != "cpu" and not device.startswith("cuda"):
        raise CpunetError(f"device {device!r} is not known; use cpu, cuda or auto")
    return device
