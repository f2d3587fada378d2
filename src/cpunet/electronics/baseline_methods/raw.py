"""The untranslated simulation, as a reference for the scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from cpunet.electronics.baseline_methods.base import check_sets, check_windows
from cpunet.electronics.extension import PADDING_AFTER, PADDING_BEFORE
from cpunet.pulses.container import FloatArray


@dataclass(frozen=True)
class Raw:
    """No electronics: the window with padding."""

    dt_ns: float
    name: ClassVar[str] = "raw"

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Fit nothing, see `BaselineMethod.fit`."""
        check_sets(sim, data, dt_ns, align)
        return cls(dt_ns)

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Pad the windows to records, see `BaselineMethod.translate`."""
        check_windows(waveforms, "simulated")
        before = np.zeros((len(waveforms), PADDING_BEFORE), np.float32)
        after = np.repeat(waveforms[:, -1:], PADDING_AFTER, axis=1)
        return np.concatenate([before, waveforms, after], axis=1, dtype=np.float32)

    def describe(self) -> Mapping[str, float]:
        """Nothing was fitted."""
        return {}
