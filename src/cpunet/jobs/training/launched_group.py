"""Process group of a training started by torchrun, and the device of each process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import torch

from cpunet.errors import CpunetError
from cpunet.jobs.common.devices import resolve_device
from cpunet.jobs.training.trainers import Trainer
from cpunet.training.process_group import ALONE, Launch, ProcessGroup, launch, meeting


@contextmanager
def group_for(trainer: Trainer, device: str) -> Iterator[tuple[ProcessGroup, str]]:
    """Join the process group of torchrun, if there is one; yield group and device.

    An error inside ends all processes and is reported by one of them, see
    `cpunet.training.process_group.meeting`.

    Parameters
    ----------
    trainer
        Method of the training.
    device
        See `cpunet.jobs.training.train.train_run`; each process uses the GPU of its local
        rank.

    Raises
    ------
    CpunetError
        If the device is missing, the recipe cannot be trained by several processes, the batch
        cannot be shared, or the processes cannot connect to each other.
    """
    launched = launch()
    if launched is None:
        yield ALONE, resolve_device(device)
        return
    with meeting(launched) as join:
        trainer.require_shareable(launched.group)
        own = _own_device(resolve_device(device), launched)
        with nullcontext() if own == "cpu" else torch.cuda.device(own):
            yield join(own), own


def _own_device(device: str, launched: Launch) -> str:
    if device == "cpu":
        return device
    if device != "cuda":
        raise CpunetError(
            f"--device {device}: each process takes the GPU of its number; give cuda"
        )
    count, number = torch.cuda.device_count(), launched.local_rank
    if number >= count:
        raise CpunetError(
            f"no GPU for process {number} of this computer, which has {count}; start torchrun "
            f"with --nproc-per-node {count}"
        )
    return f"cuda:{number}"
