"""The outcome of each channel of a file in a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from cpunet.cli.messages import tell

if TYPE_CHECKING:
    from cpunet.pulses.channels import Outcome

R = TypeVar("R")


def tell_channels(outcome: Outcome[R], out: Path, in_words: Callable[[R], str]) -> None:
    """Print a line for each channel; end with an error that counts those that failed.

    Raises
    ------
    CpunetError
        If a channel failed.
    """
    lines = {name: in_words(found) for name, found in outcome.done.items()}
    lines |= {name: f"failed: {reason}" for name, reason in outcome.failed.items()}
    width = max(map(len, lines), default=0)
    for name, line in lines.items():
        tell(f"{name:<{width}}  {line}")
    outcome.require_all(out)
