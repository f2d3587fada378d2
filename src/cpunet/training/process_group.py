"""Processes that train together, each on its share of every batch.

They are started by torchrun, which sets the rank of each and the address to connect to.  Rank 0
is the leader: only it reads checkpoints and writes files.  A single process is a group of one,
for which nothing is exchanged.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import Any

import torch
from torch import Tensor, distributed

from cpunet.errors import CpunetError

PATIENCE = timedelta(minutes=10)  # timeout for a process that does not answer
_BACKENDS = {"cpu": "gloo", "cuda": "cpu:gloo,cuda:nccl"}
_FAILURES = "cpunet/failures"
_LOST = "another process of this training ended or cannot be reached; continue with --resume"


class ToldElsewhereError(CpunetError):
    """The process group has failed; another process reports the reason."""


@dataclass(frozen=True)
class ProcessGroup:
    """The processes of a training, as seen by one of them.

    All must call the same methods in the same order.  Each raises a `CpunetError` if another
    process ended or cannot be reached.

    Parameters
    ----------
    rank
        Rank of this process, from 0.
    size
        Number of processes.
    """

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process reads checkpoints, writes and reports."""
        return self.rank == 0

    def share_of(self, batch_size: int) -> int:
        """How many pulses of a batch each process takes.

        Raises
        ------
        CpunetError
            If they cannot be shared equally.
        """
        if batch_size % self.size:
            raise CpunetError(
                f"training.batch_size={batch_size} cannot be shared equally by {self.size} "
                f"processes; give a multiple of {self.size}"
            )
        return batch_size // self.size

    def add(self, tensor: Tensor) -> None:
        """Replace the tensor of each process by the sum over all processes."""
        if self.size > 1:
            with _answered():
                distributed.all_reduce(tensor)

    def average_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Replace the gradients of each process by their mean over all processes."""
        if self.size == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])  # one message
        self.add(flat)
        flat /= self.size
        parts = torch.split(flat, [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def mean(self, losses: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Mean over the processes of scalars without gradients."""
        if self.size == 1:
            return dict(losses)
        values = torch.stack([*losses.values()])
        self.add(values)
        return dict(zip(losses, values / self.size, strict=True))

    def any(self, flag: bool) -> bool:
        """Whether a flag is true in any process.

        It is exchanged between the CPUs, so that no GPU has to be waited for.
        """
        if self.size == 1:
            return flag
        count = torch.tensor(int(flag))
        self.add(count)
        return bool(count)

    def follow(self, tensors: Iterable[Tensor]) -> None:
        """Copy the leader's values to all processes, in place."""
        if self.size == 1:
            return
        with _answered(), torch.no_grad():
            for tensor in tensors:
                distributed.broadcast(tensor, src=0)

    def told(self, content: bytes) -> bytes:
        """Return the leader's bytes in all processes."""
        if self.size == 1:
            return content
        length = torch.tensor(len(content))
        self.follow([length])
        if not length:
            return b""
        buffer = bytearray(content if self.leads else int(length))
        self.follow([torch.frombuffer(buffer, dtype=torch.uint8)])
        return bytes(buffer)

    def gathered(self, tensor: Tensor) -> list[Tensor]:
        """Return the tensors of all processes; they have the same shape."""
        if self.size == 1:
            return [tensor]
        all_of_them = [torch.empty_like(tensor) for _ in range(self.size)]
        with _answered():
            distributed.all_gather(all_of_them, tensor)
        return all_of_them


ALONE = ProcessGroup()


@dataclass(frozen=True)
class Launch:
    """Process group and local rank, as set by torchrun.

    Parameters
    ----------
    group
        Rank and size.
    local_rank
        Number of this process on its computer.
    """

    group: ProcessGroup
    local_rank: int


def launch() -> Launch | None:
    """Read the environment set by torchrun; None without it, or for a single process.

    Raises
    ------
    CpunetError
        If the environment is incomplete or invalid.
    """
    known = os.environ
    if not {"RANK", "WORLD_SIZE"} <= known.keys() or known["WORLD_SIZE"] == "1":
        return None
    for name in ("MASTER_ADDR", "MASTER_PORT", "LOCAL_RANK"):
        if not known.get(name):
            raise CpunetError(
                f"RANK and WORLD_SIZE are set, but not {name}; start with torchrun, or unset "
                "them"
            )
    try:
        rank, size, local = (int(known[n]) for n in ("RANK", "WORLD_SIZE", "LOCAL_RANK"))
    except ValueError as error:
        raise CpunetError(f"RANK, WORLD_SIZE and LOCAL_RANK: {error}") from error
    return Launch(ProcessGroup(rank, size), local)


@contextmanager
def meeting(launched: Launch) -> Iterator[Callable[[str], ProcessGroup]]:
    """Connect to the other processes; yield a function that forms the group for a device.

    The group lasts as long as the context.  If several processes fail, only the first one
    reports its error.

    Raises
    ------
    CpunetError
        If the processes do not connect.  An error raised inside is re-raised in the process
        that failed first, and becomes a `ToldElsewhereError` in the others.
    """
    if not distributed.is_available():
        raise CpunetError("this build of torch knows no other processes; install a usual one")
    from torch.distributed.rendezvous import rendezvous

    try:
        store, _, _ = next(rendezvous("env://", timeout=PATIENCE))
    except (RuntimeError, ValueError) as error:
        raise CpunetError(f"the processes of torchrun did not meet: {error}") from error
    try:
        yield partial(_join, launched, store)
    except CpunetError as error:
        # before the others notice that this process has ended
        if _is_first(store):
            raise
        raise ToldElsewhereError(str(error)) from error
    finally:
        if distributed.is_initialized():
            distributed.destroy_process_group()


def _join(launched: Launch, store: Any, device: str) -> ProcessGroup:
    with _answered():
        distributed.init_process_group(
            _BACKENDS[torch.device(device).type],
            store=store,
            rank=launched.group.rank,
            world_size=launched.group.size,
            timeout=PATIENCE,
        )
    return launched.group


def _is_first(store: Any) -> bool:
    try:
        return bool(store.add(_FAILURES, 1) == 1)
    except RuntimeError:
        return False  # the store belonged to another process, which has ended


@contextmanager
def _answered() -> Iterator[None]:
    try:
        yield
    except torch.cuda.OutOfMemoryError:
        raise
    except RuntimeError as error:
        raise CpunetError(_LOST) from error
