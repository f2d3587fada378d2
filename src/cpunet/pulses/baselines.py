"""What noise and pile-up tails need of raw traces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from cpunet.pulses.container import Pulses, Rows
from cpunet.pulses.preparation import FloatColumn, Prepared, prepare
from cpunet.recipes.schema import PreparationConfig

TRACES = 16384  # whose baselines are stored
WHOLE = 1024  # traces of the selected energies that are stored as a whole
SHORTEST_SHARE = 0.1  # fraction of the baselines that may be shorter than those used
STORED_SHARE = 0.5  # the same for those stored, since those of some traces may be longer
# Threshold of the start of a pulse, and time before it in which the pulse may already rise.
START_FRACTION, START_SIGMAS, MARGIN_NS = 0.01, 8.0, 960.0


@dataclass(frozen=True, eq=False)
class Baselines:
    """First samples and properties of the first traces of a channel, of any energy.

    Parameters
    ----------
    first
        First samples of each trace, in ADC counts, with its energy.
    prepared
        Those that can be prepared, without their windows.
    before
        Number of samples that safely precede the pulse of each prepared trace.
    height
        Height of each prepared pulse in ADC counts.
    length
        Number of samples that precede nearly all pulses.
    whole
        Whole traces that have passed the quality cuts; None if there were no cuts.
    """

    first: Pulses
    prepared: Prepared
    before: Rows
    height: FloatColumn
    length: int
    whole: Pulses | None = None

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def of(cls, blocks: Iterable[Pulses], config: PreparationConfig) -> Self:
        """Baselines of raw traces, of which no more are read than are needed.

        Parameters
        ----------
        blocks
            Measured traces of one channel with their energies, from any mixture of peaks.
        config
            Preparation settings.
        """
        parts: list[Self] = []
        for raw in blocks:
            prepared = prepare(raw, config, "measured")
            parts.append(cls.of_block(raw, prepared, config, *parts[:1]))
            if sum(map(len, parts)) >= TRACES:
                break
        return cls.concatenate(parts)

    @classmethod
    def of_block(
        cls, raw: Pulses, ready: Prepared, config: PreparationConfig, like: Self | None = None
    ) -> Self:
        """Baselines of some traces, raw and prepared, as long as those of the first ones."""
        config, windows = config.at(ready.pulses.dt_ns), ready.pulses.waveforms
        # start of the pulse proper: all samples from there to the alignment are above threshold
        level = np.maximum(START_FRACTION, START_SIGMAS * ready.baseline_rms)
        above = windows[:, : config.samples_before] >= level[:, np.newaxis]
        rise = (~above[:, ::-1]).argmax(axis=1)
        before = np.asarray(ready.align_sample - rise - config.samples(MARGIN_NS))
        if like is not None:
            length, stored = like.length, like.first.length
        else:
            shares = np.quantile(before if len(before) else [0], (SHORTEST_SHARE, STORED_SHARE))
            length, stored = (max(int(samples), 0) for samples in shares)
        first = raw.with_waveforms(raw.waveforms[:, :stored].copy())
        no_windows = ready.pulses.with_waveforms(windows[:, :0].copy())
        height = windows.max(axis=1) * ready.scale
        return cls(first, replace(ready, pulses=no_windows), before, height, length)

    @classmethod
    def concatenate(cls, parts: Sequence[Baselines]) -> Self:
        """Baselines of consecutive blocks."""
        first = Pulses.concatenate([part.first for part in parts])
        prepared = Prepared.concatenate([part.prepared for part in parts])
        before = np.concatenate([part.before for part in parts])
        height = np.concatenate([part.height for part in parts])
        return cls(first, prepared, before, height, parts[0].length)
