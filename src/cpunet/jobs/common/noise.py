"""The noise of the measured side: from raw traces, or from what windows show of it."""

from __future__ import annotations

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.remains import Remains
from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import InputFile
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import PreparationConfig

NOISE_TRACES = 4096  # from whose baselines the noise is measured
FEWEST_EMPTY = 200  # of them, if those with remains are to be left out


def measured_noise(
    data_file: InputFile,
    windows: Pulses,
    config: PreparationConfig,
    remains: Remains | None = None,
) -> tuple[BaselineNoise, str | None]:
    """Measure the noise of a file of measured pulses.

    Parameters
    ----------
    data_file
        The file, of raw traces if possible.
    windows
        Its prepared pulses, used if its traces have no long baselines.
    config
        How they were prepared.
    remains
        Of earlier pulses under the traces: baselines with them are no noise.

    Returns
    -------
    tuple
        The noise, and what is to be said about it, if anything.

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
    data_file: InputFile, config: PreparationConfig, remains: Remains | None = None
) -> BaselineNoise:
    """Measure the noise from the raw samples before the pulses.

    Where traces have remains of earlier pulses, from those that lie as low as empty baselines.

    Raises
    ------
    CpunetError
        If there are too few, or they are too short.
    """
    block = next(iter(data_file.open().blocks(NOISE_TRACES)), None)
    if block is None:
        raise CpunetError(f"{data_file.path}: holds no traces to measure the noise from")
    known = np.isfinite(block.energy_kev) & (block.energy_kev > 0)
    if remains is not None and remains.law is not None:
        empty = known & remains.empty(block)
        known = empty if empty.sum() >= FEWEST_EMPTY else known
    return BaselineNoise.from_traces(block[known], config)
