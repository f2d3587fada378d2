"""Pulses of whole events: sums of the pulses of their hits, weighted by energy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import prange

from cpunet.kernels import kernel
from cpunet.pulses.container import Pulses
from cpunet.simulation.drift import FWHM_PER_SIGMA, smear_and_sample
from cpunet.simulation.field_lookup import DriftMaps, drift_maps, in_active_volume
from cpunet.simulation.fields import FieldMaps
from cpunet.simulation.hits import Hits
from cpunet.simulation.library_lookup import PulseLibrary, add_pulse, covers
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.signals import Task, drift_task, hit_table, point_signal
from cpunet.simulation.velocity import FloatArray

# Events per task of a thread.
_CHUNK = 25
# Outcomes of a hit.
COLLECTED, NO_SIGNAL, NOT_COLLECTED, INTERPOLATED = range(4)


@dataclass(frozen=True, eq=False)
class EventPulses:
    """Pulses of events, in units of the charge that gives a signal.

    Parameters
    ----------
    waveforms
        Float32 array (n_events, samples); zero for events without any signal.
    dt_ns
        Sampling period in ns.
    energy_kev
        Energy deposited in each event in keV.
    lost_kev
        Part of it in hits without a signal: in a contact or its dead layer, outside the
        crystal, or in germanium without a field.
    trapped_kev
        Part of it whose signal is lost to trapping.
    event_number
        Event numbers of the source.
    outcome
        Outcome of each hit: `COLLECTED`, `NO_SIGNAL`, `NOT_COLLECTED` within the record, or
        `INTERPOLATED` between pulses of the library.
    """

    waveforms: npt.NDArray[np.float32]
    dt_ns: float
    energy_kev: FloatArray
    lost_kev: FloatArray
    trapped_kev: FloatArray
    event_number: npt.NDArray[np.int64]
    outcome: npt.NDArray[np.int8]

    @property
    def collected_kev(self) -> FloatArray:
        """Energy in keV that gives a signal, which is what a detector measures."""
        return self.energy_kev - self.lost_kev - self.trapped_kev

    def pulses(self) -> Pulses:
        """Events with a signal as `Pulses`, with their collected energies."""
        kept = self.collected_kev > 0
        return Pulses.of(
            self.waveforms[kept],
            dt_ns=self.dt_ns,
            energy_kev=self.collected_kev[kept],
            event_number=self.event_number[kept],
        )


def simulate_events(
    fields: FieldMaps,
    hits: Hits,
    settings: SimulationSettings,
    library: PulseLibrary | None = None,
    stride: int = 1,
) -> EventPulses:
    r"""Simulate the pulse of each event, in parallel over the events.

    The pulse is the energy-weighted mean of the pulses :math:`S_i` of its hits,

    .. math:: S = \frac{\sum_i E_i S_i}{\sum_i E_i (1 - t_i)},

    over all hits with a signal, with the trapped fractions :math:`t_i`.

    Parameters
    ----------
    fields
        Field maps of the detector.
    hits
        Energy deposits of the events.
    settings
        Simulation settings.
    library
        Pre-computed pulses for the same fields and settings, to interpolate between; only hits
        where these are not accurate enough are drifted. Without it all are.
    stride
        Number of time steps that a step of the drift replaces, a divisor of those per sample.

    Raises
    ------
    CpunetError
        If the position or energy of a hit is not finite.
    """
    table = hit_table(hits.x_mm, hits.y_mm, hits.z_mm, hits.edep_kev)
    maps = drift_maps(fields, settings)
    n = hits.n_events
    waveforms = np.zeros((n, settings.n_samples), np.float32)
    lost_kev, trapped_kev = np.zeros(n), np.zeros(n)
    outcome = np.zeros(len(table), np.int8)
    task = drift_task(fields, settings, stride)
    sums = (waveforms, lost_kev, trapped_kev, outcome)
    _sum_events(maps, library, table, hits.offsets, task, *sums)
    return EventPulses(
        waveforms=waveforms,
        dt_ns=settings.dt_ns,
        energy_kev=hits.energy_kev,
        lost_kev=lost_kev,
        trapped_kev=trapped_kev,
        event_number=hits.event_number,
        outcome=outcome,
    )


@kernel(parallel=True)
def _sum_events(
    maps: DriftMaps,
    library: PulseLibrary | None,
    hits: FloatArray,
    offsets: npt.NDArray[np.int64],
    task: Task,
    waveforms: npt.NDArray[np.float32],
    lost_kev: FloatArray,
    trapped_kev: FloatArray,
    outcome: npt.NDArray[np.int8],
) -> None:
    """Fill the pulses and energies of events; compiled once with a library and once without."""
    n_events, n_samples = waveforms.shape
    # work arrays are shared by a chunk of events
    for chunk in prange((n_events + _CHUNK - 1) // _CHUNK):
        out = np.empty(n_samples)
        quick = np.empty(n_samples, np.float32)
        steps = np.empty(n_samples + 1)
        signal = np.empty(n_samples * task.per_sample)
        for event in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n_events)):
            out[:] = 0.0
            quick[:] = 0.0
            steps[:] = 0.0
            lost = collected = trapped = 0.0
            for i in range(offsets[event], offsets[event + 1]):
                hit = hits[i]
                if not in_active_volume(maps, hit[0], hit[1], hit[2]):
                    outcome[i] = NO_SIGNAL
                    lost += hit[3]
                    continue
                collected += hit[3]
                known = False
                if library is not None:
                    known = covers(library, hit[0], hit[1], hit[2], hit[3])
                    if known:
                        outcome[i] = INTERPOLATED
                        trapped += add_pulse(library, hit, hit[3], 0, quick, steps)
                if not known:
                    outcome[i], part = _add_drifted(maps, hit, task, signal, out)
                    trapped += hit[3] * part
            lost_kev[event], trapped_kev[event] = lost, trapped
            if collected <= trapped:
                continue
            if library is None:
                for j in range(n_samples):
                    waveforms[event, j] = out[j] / (collected - trapped)
            else:
                share, flat = 1.0 / (collected - trapped), 0.0
                for j in range(n_samples):
                    flat += steps[j]
                    waveforms[event, j] = (out[j] + quick[j] + flat) * share


@kernel
def _add_drifted(
    maps: DriftMaps, hit: FloatArray, task: Task, signal: FloatArray, out: FloatArray
) -> tuple[int, float]:
    """Add the pulse of one drifted hit to `out`; return its outcome and trapped fraction."""
    last, arrived, fwhm, trapped = point_signal(maps, hit, task, signal)
    smear_and_sample(signal, task.per_sample, fwhm / FWHM_PER_SIGMA, last, hit[3], out)
    return COLLECTED if arrived else NOT_COLLECTED, trapped
