"""The known answer of a test stand, made comparable with translated pulses."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.jobs.inputs import InputSet
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import PreparationConfig


def load_truth(path: Path, sim: InputSet, config: PreparationConfig) -> FloatArray:
    """Read the noise-free response of each simulated pulse, prepared like data.

    Parameters
    ----------
    path
        ``.npz`` with ``response``, shape (pulses of the simulation file, samples).
    sim
        The simulated pulses in use.
    config
        The preparation of the run.

    Returns
    -------
    array
        Shape (pulses in use, window); NaN where a response cannot be prepared.

    Raises
    ------
    CpunetError
        If the file is not readable or belongs to other pulses.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            if "response" not in archive:
                raise CpunetError(
                    f"{path}: has no array 'response' (found {', '.join(archive) or 'none'})"
                )
            response = archive["response"]
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise CpunetError(f"{path}: cannot be read as .npz ({error})") from error
    if response.ndim != 2 or len(response) != sim.prepared.n_read:
        raise CpunetError(
            f"{path}: response has shape {response.shape}, but {sim.path} holds "
            f"{sim.prepared.n_read} pulses; give the truth of that file"
        )
    used = Pulses.of(response[sim.prepared.index], dt_ns=sim.dt_ns)
    prepared = prepare(used, config, "measured")
    windows = np.full((len(used), config.length), np.nan, np.float32)
    windows[prepared.index] = prepared.pulses.waveforms
    return windows
