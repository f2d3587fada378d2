"""What the leading process of a team tells the others before they begin."""

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
from cpunet.training.team import Team


def share_state(team: Team, state: State | None) -> State | None:
    """Give all processes the leader's state to go on from, or None; no file is shared.

    Parameters
    ----------
    team
        Who trains.
    state
        The leader's; of no account in other processes.
    """
    if team.size == 1:
        return state
    with TemporaryDirectory(prefix="cpunet-team-") as name:
        folder, content = Path(name), b""
        if team.leads and state is not None:
            write_checkpoint(folder, Checkpoint(state, {}))
            content = (folder / CHECKPOINT).read_bytes()
        content = team.told(content)
        if team.leads or not content:
            return state if team.leads else None
        (folder / CHECKPOINT).write_bytes(content)
        received = next(read_checkpoints(folder))
    if received is None:
        raise CpunetError(
            "the checkpoint did not reach this process whole; go on with --resume"
        )
    return received.state


def require_same_everywhere(team: Team, fingerprint: dict[str, Any]) -> None:
    """Refuse to train together on other pulses or with other settings.

    Raises
    ------
    CpunetError
        Naming a process whose fingerprint differs from the leader's.
    """
    digest = hashlib.sha256(json.dumps(fingerprint, sort_keys=True).encode()).digest()
    digests = team.gathered(torch.frombuffer(bytearray(digest), dtype=torch.uint8))
    for rank, other in enumerate(digests):
        if not torch.equal(other, digests[0]):
            raise CpunetError(
                f"process {rank} has other settings or pulses than process 0; start all with "
                "the same options and files"
            )
