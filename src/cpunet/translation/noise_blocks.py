"""Blocks of pulses of a fixed size, each with its own noise seed, and counts of the results."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from cpunet.electronics.in_trace_pile_up import Columns
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Rejection
from cpunet.translation.forms import Formed

NOISE_ROWS = 512  # pulses per noise seed, however many are read at a time


def noise_seed(seed: int, key: str | None, block: int, realisation: int = 0) -> int:
    """Seed of the noise of a block of a file.

    Parameters
    ----------
    seed
        Seed of the translation.
    key
        Name of the file or the channel; None for a single file, whose first block then has
        `seed` itself, as in `cpunet.translation.translator.Translator.translate`.
    block
        Number of the block in the file.
    realisation
        Number of times that its noise was drawn before.
    """
    if key is None and block == realisation == 0:
        return int(seed)
    # names of files need not be UTF-8
    digest = hashlib.sha256((key or "").encode(errors="surrogateescape")).digest()
    words = [seed, block, realisation, int.from_bytes(digest[:16])]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> np.uint64(1))


def regrouped(blocks: Iterable[Pulses], size: int) -> Iterator[Pulses]:
    """The same pulses in blocks of `size`, the last one shorter.

    Examples
    --------
    >>> pulses = Pulses.of(np.zeros((7, 2)), dt_ns=16)
    >>> [len(block) for block in regrouped([pulses[:2], pulses[2:3], pulses[3:]], 3)]
    [3, 3, 1]
    """
    waiting: list[Pulses] = []
    for block in blocks:
        first = 0
        while first < len(block):
            room = size - sum(map(len, waiting))
            waiting.append(block[first : first + room])
            first += room
            if sum(map(len, waiting)) == size:
                yield Pulses.concatenate(waiting)
                waiting = []
    if waiting:
        yield Pulses.concatenate(waiting)


def interleaved(realisations: list[Formed]) -> Formed:
    """Realisations of the same pulses as numbered rows: all of a pulse, then of the next."""
    if len(realisations) == 1:
        return realisations[0]
    n, first = len(realisations), realisations[0].pulses
    rows = np.repeat(np.arange(len(first)), n)
    waveforms = np.stack([formed.pulses.waveforms for formed in realisations], axis=1)
    truth: Columns = {
        name: (np.stack([each.truth[name][0] for each in realisations], axis=1).ravel(), units)
        for name, (_, units) in realisations[0].truth.items()
    }
    return Formed(
        Pulses.of(
            waveforms.reshape(len(rows), first.length),
            dt_ns=first.dt_ns,
            energy_kev=first.energy_kev[rows],
            event_number=first.event_number[rows],
        ),
        np.stack([formed.codes for formed in realisations], axis=1).ravel(),
        np.stack([formed.saturated for formed in realisations], axis=1).ravel(),
        truth | {"realisation": (np.tile(np.arange(n), len(first)), "")},
    )


def joined(blocks: list[Formed]) -> Formed:
    """The rows of all blocks."""
    return Formed(
        Pulses.concatenate([block.pulses for block in blocks]),
        np.concatenate([block.codes for block in blocks]),
        np.concatenate([block.saturated for block in blocks]),
        {
            name: (np.concatenate([block.truth[name][0] for block in blocks]), units)
            for name, (_, units) in blocks[0].truth.items()
        },
    )


class Counts:
    """Numbers of written rows, with the reasons why some contain no pulse."""

    def __init__(self) -> None:
        self.codes = np.zeros(256, np.int64)
        self.saturated = 0

    def add(self, formed: Formed) -> None:
        """Count the rows of a block."""
        self.codes += np.bincount(formed.codes, minlength=len(self.codes))
        self.saturated += int(formed.saturated.sum())

    def summary(self, *, adc: bool) -> dict[str, Any]:
        """Numbers of rows read, translated and rejected by reason, in ADC also of saturated."""
        rejected = [code for code in np.flatnonzero(self.codes) if code]
        summary = {
            "read": int(self.codes.sum()),
            "translated": int(self.codes[Rejection.ACCEPTED]),
            "rejections": {Rejection(int(c)).label: int(self.codes[c]) for c in rejected},
        }
        return summary | ({"saturated": self.saturated} if adc else {})
