"""Noise of simulated pulses, drawn once.

A fit compares many responses.  All of them have the same noise, so that their differences are
those of the responses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_pile_up import DrawnTails
from cpunet.kernels import kernel
from cpunet.pulses.container import FloatArray
from cpunet.training.aligned import Samples, Values

# Maximum number of noise traces, each twice as long as a record.  For more pulses,
# they share the traces, with other start samples and signs.
NOISE_TRACES = 4096


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise for a set of pulses, the same at each use.

    Parameters
    ----------
    traces
        For an energy of 1 keV, shape (traces, samples).
    trace, start, factor
        Trace, start sample, and sign divided by energy, for each draw and pulse; each of shape
        (draws, pulses).
    left, decay
        Pile-up tails for each record, shape (draws, pulses), and their decay over
        a record, shape (samples,); None for none.
    """

    traces: FloatArray
    trace: npt.NDArray[np.intp]
    start: npt.NDArray[np.intp]
    factor: FloatArray
    left: FloatArray | None = None
    decay: FloatArray | None = None

    @classmethod
    def draw(
        cls,
        noise: BaselineNoise,
        energy_kev: Values,
        length: int,
        pairs: int,
        rng: np.random.Generator,
        tails: DrawnTails | None = None,
    ) -> Noise:
        """Draw noise for records of `length` samples.

        The two draws of a pair are of opposite sign, so that the contribution of noise to a
        mean cancels.
        """
        n = len(energy_kev)
        n_traces = min(NOISE_TRACES, n * pairs)
        traces = noise.draw(np.ones(n_traces), 2 * length, rng)
        # each trace is used before any is used again
        trace = np.concatenate(
            [rng.permutation(n_traces) for _ in range(-(-n * pairs // n_traces))]
        )
        trace = np.repeat(trace[: n * pairs].reshape(pairs, n), 2, axis=0)
        sign = rng.choice((-1.0, 1.0), (pairs, n))
        start = np.repeat(rng.integers(0, length + 1, (pairs, n)), 2, axis=0)
        factor = np.stack([sign, -sign], axis=1).reshape(2 * pairs, n) / energy_kev
        left = decay = None
        if tails is not None:
            left = np.stack([tails.factors(energy_kev, rng) for _ in range(2 * pairs)])
            decay = np.asarray(tails.decay(length), np.float32)
        return cls(traces, trace, start, np.asarray(factor, np.float32), left, decay)

    def of(self, rows: Samples | npt.NDArray[np.bool_] | slice) -> Noise:
        """Noise of some of the pulses."""
        return replace(
            self,
            trace=np.ascontiguousarray(self.trace[:, rows]),
            start=np.ascontiguousarray(self.start[:, rows]),
            factor=np.ascontiguousarray(self.factor[:, rows]),
            left=None if self.left is None else self.left[:, rows],
        )

    def add(self, records: FloatArray, draw: int) -> FloatArray:
        """Records of the pulses with the noise of a draw."""
        noisy = np.empty(records.shape, np.float32)
        trace, start, factor = (each[draw] for each in (self.trace, self.start, self.factor))
        _add(records, self.traces, trace, start, factor, noisy)
        if self.left is not None and self.decay is not None:
            noisy += self.left[draw, :, np.newaxis] * self.decay
        return noisy


@kernel(error_model="numpy")
def _add(
    records: Any, traces: Any, trace: Any, start: Any, factor: Any, noisy: Any
) -> None:  # pragma: no cover - compiled
    """Add part of a noise trace to each record: index of the trace, start sample, factor."""
    for row in range(len(records)):
        drawn, first, scale = traces[trace[row]], start[row], factor[row]
        for i in range(records.shape[1]):
            noisy[row, i] = records[row, i] + scale * drawn[first + i]
