"""Charge pulses of single hits: drift of both carriers, Shockley-Ramo, charge cloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from cpunet.errors import CpunetError
from cpunet.kernels import kernel
from cpunet.simulation.drift import (
    FWHM_PER_SIGMA,
    SMALLEST_FWHM_MM,
    diffusion_constant,
    drift,
    repulsion_constant,
    smear_and_sample,
)
from cpunet.simulation.field_lookup import DriftMaps, drift_maps, in_active_volume
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.hits import FARTHEST_MM
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.velocity import ELECTRON, HOLE, FloatArray

# Duration of the cloud: as it is, in whole steps as in siggen, or longer by one step, the mean
# of siggen's rounding.
EXACT, WHOLE, WHOLE_ON_AVERAGE = range(3)


class Task(NamedTuple):
    """Parameters of the compiled loops, besides the maps, for drifting and smearing.

    The cloud starts with a FWHM of `cloud_fwhm_mm`; see `cpunet.simulation.drift` for
    `diffusion` and `repulsion_per_kev`. `rounding` of its duration is `EXACT`, `WHOLE` or
    `WHOLE_ON_AVERAGE`. A step of the drift lasts `step_ns` and replaces `stride` time steps;
    `per_sample` is the number of steps of the drift per sample.
    """

    cloud_fwhm_mm: float
    diffusion: float
    repulsion_per_kev: float
    rounding: int
    step_ns: float
    stride: int
    per_sample: int
    n_samples: int


@dataclass(frozen=True, eq=False)
class Signals:
    """Pulses of single hits, in units of the charge of the hit.

    Parameters
    ----------
    waveforms
        Float32 array of shape ``(n, samples)``; 0 where `valid` is false.
    dt_ns
        Sampling period in ns.
    valid
        Whether a hit gives a signal. Hits in a contact, outside the crystal or in germanium
        without a field do not.
    collected
        Whether both carriers were collected within the record.
    collection_time_ns
        Time in ns at which the last carrier was collected or the record ended; NaN if not
        valid.
    cloud_fwhm_ns
        FWHM in ns of the smearing by the charge cloud; NaN if not valid.
    trapped
        Fraction of the signal lost to trapping; NaN if not valid.
    """

    waveforms: npt.NDArray[np.float32]
    dt_ns: float
    valid: npt.NDArray[np.bool_]
    collected: npt.NDArray[np.bool_]
    collection_time_ns: FloatArray
    cloud_fwhm_ns: FloatArray
    trapped: FloatArray


def hit_signals(
    fields: FieldMaps,
    x_mm: npt.ArrayLike,
    y_mm: npt.ArrayLike,
    z_mm: npt.ArrayLike,
    edep_kev: npt.ArrayLike,
    settings: SimulationSettings,
) -> Signals:
    r"""Simulate the charge pulse of each hit, in parallel over the hits.

    An electron and a hole drift from the same point in explicit steps. By the Shockley-Ramo
    theorem the induced charge, in units of the charge of the hit, is the difference of the
    weighting potential :math:`\phi_w` between hole and electron,

    .. math:: S(t) = \phi_w(\mathbf{x}_h(t)) - \phi_w(\mathbf{x}_e(t)).

    The pulse is convolved with a Gaussian as long as the charge cloud takes to enter the
    contact, and averaged over each sample.

    Parameters
    ----------
    fields
        Field maps of the detector.
    x_mm, y_mm, z_mm
        Positions of the hits in mm in the frame of the crystal.
    edep_kev
        Energies of the hits in keV. They affect only the self-repulsion of the cloud.
    settings
        Simulation settings.

    Raises
    ------
    CpunetError
        If a coordinate or an energy is not finite.

    References
    ----------
    Z. He, NIM A 463 (2001) 250 (Shockley-Ramo); D. C. Radford, siggen.

    Examples
    --------
    In a planar detector of thickness :math:`d` the pulse rises by :math:`(v_e + v_h)/d`.

    >>> from types import SimpleNamespace
    >>> from cpunet.simulation.velocity import carrier_velocity, velocity_table
    >>> height = np.tile(np.arange(11.0), (11, 1))  # z in mm
    >>> planar = SimpleNamespace(
    ...     grid_mm=1.0, potential_V=100 * height, weighting_potential=1 - height / 10,
    ...     e_r_V_per_cm=0 * height, e_z_V_per_cm=0 * height - 1000,
    ...     region=np.full((11, 11), 2, np.int8), temperature_K=90.0)
    >>> point = SimulationSettings(dt_ns=1, length_ns=200, diffusion=False, cloud_fwhm_mm=0)
    >>> pulse = hit_signals(planar, 0.0, 0.0, [5.0], 100.0, point).waveforms[0]
    >>> v_e, v_h = (
    ...     abs(carrier_velocity(*velocity_table(90), carrier, 0.0, 0.0, -1000.0)[2])
    ...     for carrier in (ELECTRON, HOLE))
    >>> bool(abs(pulse[20] - 20 * (v_e + v_h) / 10) < 1e-3), round(float(pulse[-1]), 3)
    (True, 1.0)
    """
    hits = hit_table(x_mm, y_mm, z_mm, edep_kev)
    n = len(hits)
    waveforms = np.zeros((n, settings.n_samples), np.float32)
    facts = np.full((n, 4), np.nan)
    _all_signals(
        drift_maps(fields, settings), hits, drift_task(fields, settings), waveforms, facts
    )
    valid = np.isfinite(facts[:, 0])
    return Signals(
        waveforms=waveforms,
        dt_ns=settings.dt_ns,
        valid=valid,
        collected=facts[:, 1] == 1.0,
        collection_time_ns=facts[:, 0] * settings.step_ns,
        cloud_fwhm_ns=facts[:, 2] * settings.step_ns,
        trapped=facts[:, 3],
    )


def hit_table(
    x_mm: npt.ArrayLike, y_mm: npt.ArrayLike, z_mm: npt.ArrayLike, edep_kev: npt.ArrayLike
) -> FloatArray:
    """Hits as rows x, y, z (mm), energy (keV); see `hit_signals` for invalid input."""
    columns = np.broadcast_arrays(x_mm, y_mm, z_mm, edep_kev)
    table = np.ascontiguousarray(np.stack(columns, axis=-1), dtype=np.float64).reshape(-1, 4)
    near = (np.abs(table[:, :3]) <= FARTHEST_MM).all(1)  # NaN is not
    bad = np.flatnonzero(~(near & np.isfinite(table[:, 3])))
    if len(bad):
        raise CpunetError(f"hits: hit {bad[0]}: no finite place or energy; leave it out")
    return table


def drift_task(fields: FieldMaps, settings: SimulationSettings, stride: int = 1) -> Task:
    """Parameters of the compiled loops for some settings.

    A drift step replaces `stride` time steps, a divisor of their number per sample.
    """
    constant = diffusion_constant(settings.diffusion_constant, fields.temperature_K)
    growing = settings.diffusion or settings.self_repulsion > 0
    return Task(
        cloud_fwhm_mm=max(settings.cloud_fwhm_mm, SMALLEST_FWHM_MM if growing else 0.0),
        diffusion=constant if settings.diffusion else 0.0,
        repulsion_per_kev=repulsion_constant(1.0) * settings.self_repulsion,
        rounding=WHOLE if settings.diffusion_constant == "siggen" else EXACT,
        step_ns=stride * settings.step_ns,
        stride=stride,
        per_sample=settings.steps_per_sample // stride,
        n_samples=settings.n_samples,
    )


@kernel
def point_signal(
    maps: DriftMaps, hit: FloatArray, task: Task, signal: FloatArray
) -> tuple[int, bool, float, float]:
    """Fill `signal` with the pulse of a point charge.

    Returns the last step, whether all charge is collected, the FWHM in steps of the smearing
    by the cloud, and the fraction trapped.
    """
    signal[:] = 0.0
    start = (hit[0], hit[1], hit[2])
    nowhere = np.empty((0, 3))
    point = (0.0, 0.0, 0.0)
    growing = (task.cloud_fwhm_mm, task.diffusion, task.repulsion_per_kev * hit[3])
    steps_e, arrived_e, _, _, trapped_e = drift(
        maps, ELECTRON, start, task.step_ns, task.stride, point, signal, nowhere
    )
    steps_h, arrived_h, size, speed, trapped_h = drift(
        maps, HOLE, start, task.step_ns, task.stride, growing, signal, nowhere
    )
    fwhm = cloud_steps(size, speed, task)
    if task.stride > 1:  # means over the time steps that a step of the drift replaces
        later = (task.stride - 1) / (2 * task.stride)
        for i in range(len(signal) - 1):
            signal[i] += later * (signal[i + 1] - signal[i])
    last = max(steps_e, steps_h)
    return last, arrived_e and arrived_h, fwhm, trapped_e + trapped_h


@kernel
def cloud_steps(size: float, speed: float, task: Task) -> float:
    """FWHM in steps of the cloud entering the contact."""
    if size <= 0.0 or speed <= 0.0:
        return 0.0
    fwhm = size / (speed * task.step_ns)
    if task.rounding == WHOLE:
        rounded = int(1.5 + fwhm)
        return float(rounded) if rounded > 1 else 0.0
    return fwhm + 1.0 if task.rounding == WHOLE_ON_AVERAGE else fwhm


@kernel(parallel=True)
def _all_signals(
    maps: DriftMaps,
    hits: FloatArray,
    task: Task,
    waveforms: npt.NDArray[np.float32],
    facts: FloatArray,
) -> None:
    for i in prange(len(hits)):
        if not in_active_volume(maps, hits[i, 0], hits[i, 1], hits[i, 2]):
            continue
        signal = np.empty(task.n_samples * task.per_sample)
        out = np.zeros(task.n_samples)
        last, arrived, fwhm, trapped = point_signal(maps, hits[i], task, signal)
        smear_and_sample(signal, task.per_sample, fwhm / FWHM_PER_SIGMA, last, 1.0, out)
        for j in range(len(out)):
            waveforms[i, j] = out[j]
        facts[i, 0], facts[i, 1] = last, 1.0 if arrived else 0.0
        facts[i, 2], facts[i, 3] = fwhm, trapped
