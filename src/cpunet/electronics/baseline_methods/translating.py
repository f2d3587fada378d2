"""Translation of simulated pulses by a baseline method, prepared like the data."""

from __future__ import annotations

import numpy as np

from cpunet.electronics.baseline_methods.base import BaselineMethod
from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_remains import TraceNoise
from cpunet.electronics.finishing import blocks, finish
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import PreparationConfig


def translate_like_data(
    method: BaselineMethod,
    pulses: Pulses,
    config: PreparationConfig,
    *,
    noise: BaselineNoise | TraceNoise | None = None,
    seed: int | np.random.Generator = 0,
) -> Pulses:
    """Translate prepared simulated pulses and prepare them like the data.

    Parameters
    ----------
    method
        A fitted baseline method.
    pulses
        Prepared simulated pulses.
    config
        Preparation settings of the run.
    noise, seed
        As for `finish`, with the energies of the pulses.

    Returns
    -------
    Pulses
        The same events. A row is NaN if the pulse cannot be prepared.

    Raises
    ------
    CpunetError
        If the sampling period differs from that of the fit, or for the reasons of `finish`.
    """
    if not np.isclose(pulses.dt_ns, method.dt_ns):
        raise CpunetError(
            f"the pulses are sampled every {pulses.dt_ns:g} ns, {method.name} was fitted to "
            f"{method.dt_ns:g} ns; resample the pulses"
        )
    rng = np.random.default_rng(seed)
    windows = np.empty((len(pulses), config.length), np.float32)
    for rows in blocks(len(pulses)):
        part = pulses[rows]
        windows[rows] = finish(
            method.translate(part.waveforms),
            config,
            dt_ns=pulses.dt_ns,
            noise=noise,
            energy_kev=part.energy_kev,
            seed=rng,
        )
    return pulses.with_waveforms(windows)
