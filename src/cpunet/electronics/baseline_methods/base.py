"""Interface of the baseline methods, and checks of their input."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Protocol, Self

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray

Values = npt.NDArray[np.float64]

MIN_N = 50  # minimum number of pulses of either dataset for a fit


class BaselineMethod(Protocol):
    """A baseline method: a causal linear response fitted to unpaired pulses."""

    name: ClassVar[str]

    @property
    def dt_ns(self) -> float:
        """Sampling period in ns of the pulses in the fit."""

    @classmethod
    def fit(cls, sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> Self:
        """Fit to simulated and measured pulses of different events.

        Parameters
        ----------
        sim, data
            Prepared windows, shape ``(n, length)``. Simulated ones range from 0 to 1.
        dt_ns
            Sampling period in ns.
        align
            Sample at which both are aligned.

        Raises
        ------
        CpunetError
            If there are too few pulses, if any is not finite, or if the datasets differ in
            length.
        """

    def translate(self, waveforms: FloatArray) -> FloatArray:
        """Noise-free response to simulated windows.

        Returns
        -------
        numpy.ndarray
            Records with padding on both sides of the window (see `response`), neither
            aligned nor normalised. `finishing.finish` converts them into windows.
        """

    def describe(self) -> Mapping[str, float]:
        """Fitted values by name. Each name ends with the unit."""


def check_sets(sim: FloatArray, data: FloatArray, dt_ns: float, align: int) -> None:
    """Raise a `CpunetError` unless a response can be fitted to the two datasets."""
    for side, windows in (("simulated", sim), ("measured", data)):
        check_windows(windows, side)
        if len(windows) < MIN_N:
            raise CpunetError(
                f"{len(windows)} {side} pulses; give {MIN_N} or more to fit a response to"
            )
    if sim.shape[1] != data.shape[1]:
        raise CpunetError(
            f"simulated windows have {sim.shape[1]} samples, measured ones {data.shape[1]}; "
            "prepare both with one recipe"
        )
    if not (np.isfinite(dt_ns) and dt_ns > 0):
        raise CpunetError(f"the sampling period is {dt_ns} ns; expected more than 0")
    if not 8 <= align <= sim.shape[1] - 8:
        raise CpunetError(
            f"windows of {sim.shape[1]} samples cannot be aligned at sample {align}; "
            "give the recipe's samples_before"
        )


def check_windows(windows: FloatArray, side: str) -> None:
    """Raise a `CpunetError` unless the waveforms are finite, with one waveform per row."""
    if windows.ndim != 2 or windows.shape[1] < 2:
        raise CpunetError(
            f"{side} waveforms have shape {windows.shape}; expected (pulses, samples)"
        )
    finite = np.isfinite(windows).all(axis=1)
    if not finite.all():
        raise CpunetError(
            f"{side} pulse {int(np.argmin(finite))} has values that are not finite; "
            "leave it out"
        )
