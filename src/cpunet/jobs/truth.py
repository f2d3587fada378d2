"""The known answer of a test stand, made comparable with translated pulses."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from cpunet.electronics.finishing import finish
from cpunet.errors import CpunetError
from cpunet.jobs.inputs import InputSet
from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import PreparationConfig


def load_truth(path: Path, sim: InputSet, config: PreparationConfig) -> FloatArray:
    """Read the noise-free response of each simulated pulse, prepared like data.

    Parameters
    ----------
    path, sim
        As for `read_response`.
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
    return finish(read_response(path, sim), config, dt_ns=sim.dt_ns)


def read_response(path: Path, sim: InputSet) -> FloatArray:
    """Read the noise-free trace of each simulated pulse in use.

    Parameters
    ----------
    path
        ``.npz`` with ``response``, shape (pulses of the simulation file, samples).
    sim
        The simulated pulses in use.

    Returns
    -------
    array
        Float32, shape (pulses in use, samples).

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
    return np.ascontiguousarray(response[sim.prepared.index], dtype=np.float32)
