"""Share the state of the leading process with the others, and compare their settings."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from cpunet.errors import CpunetError
from cpunet.training.checkpoints import (
    CHECKPOINT,
    Checkpoint,
    read_checkpoints,
    write_checkpoint,
)
from cpunet.training.loop import State
from cpunet.training.process_group import ProcessGroup


def share_state(group: ProcessGroup, state: State | None) -> State | None:
    """Send the leader's state, or None, to all processes; no shared file system is needed.

    Parameters
    ----------
    group
        Process group.
    state
        State of the leader to continue from; ignored in other processes.
    """
    if group.size == 1:
        return state
    with TemporaryDirectory(prefix="cpunet-group-") as name:
        folder, content = Path(name), b""
        if group.leads and state is not None:
            write_checkpoint(folder, Checkpoint(state, {}))
            content = (folder / CHECKPOINT).read_bytes()
        content = group.told(content)
        if group.leads or not content:
            return state if group.leads else None
        (folder / CHECKPOINT).write_bytes(content)
        received = next(read_checkpoints(folder))
    if received is None:
        raise CpunetError(
            "the checkpoint did not reach this process whole; continue with --resume"
        )
    return received.state


def require_same_everywhere(group: ProcessGroup, fingerprint: dict[str, Any]) -> None:
    """Require the same pulses and settings in all processes.

    Raises
    ------
    CpunetError
        If a fingerprint differs from the leader's; the message names the process.
    """
    digest = hashlib.sha256(json.dumps(fingerprint, sort_keys=True).encode()).digest()
    digests = group.gathered(torch.frombuffer(bytearray(digest), dtype=torch.uint8))
    for rank, other in enumerate(digests):
        if not torch.equal(other, digests[0]):
            raise CpunetError(
                f"process {rank} has other settings or pulses than process 0; start all with "
                "the same options and files"
            )
