"""Noise of the measured pulses, from raw traces or else from prepared windows."""

from __future__ import annotations

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.remains import Remains
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import PreparationConfig

NOISE_TRACES = 4096  # number of traces whose baselines determine the noise
MIN_EMPTY = 200  # minimum number of these if traces with remains are left out


def measured_noise(
    data_file: PulseFile,
    windows: Pulses,
    config: PreparationConfig,
    remains: Remains | None = None,
) -> tuple[BaselineNoise, str | None]:
    """Measure the noise of a file of measured pulses.

    Parameters
    ----------
    data_file
        File of measured pulses, preferably raw traces.
    windows
        Prepared pulses of the file, used if its traces have no long baselines.
    config
        Preparation of the pulses.
    remains
        Remains of earlier pulses in the traces; baselines with remains are left out.

    Returns
    -------
    tuple
        Noise, and a remark on it or None.

    Raises
    ------
    CpunetError
        If neither traces nor windows have enough flat baselines.
    """
    try:
        return noise_of_traces(data_file, config, remains), None
    except CpunetError as error:
        half = config.baseline_samples // 2
        noise = BaselineNoise.from_windows(windows, half)
        return noise, f"noise is taken from {half} samples a pulse: {error}"


def noise_of_traces(
    data_file: PulseFile, config: PreparationConfig, remains: Remains | None = None
) -> BaselineNoise:
    """Measure the noise from the raw samples before the pulses.

    If traces have remains of earlier pulses, only those at the level of empty baselines are
    used.

    Raises
    ------
    CpunetError
        If the baselines are too few or too short.
    """
    block = next(data_file.open().blocks(NOISE_TRACES))
    known = np.isfinite(block.energy_kev) & (block.energy_kev > 0)
    if remains is not None and remains.law is not None:
        empty = known & remains.empty(block)
        known = empty if empty.sum() >= MIN_EMPTY else known
    return BaselineNoise.from_traces(block[known], config)
