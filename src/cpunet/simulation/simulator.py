"""Pulses of single charges and of events, whose nearby hits are merged; paths of charges."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import ArrayLike, NDArray

from cpunet.errors import CpunetError
from cpunet.kernels import kernel
from cpunet.progress import stage
from cpunet.pulses.container import Pulses
from cpunet.simulation.drift import FWHM_PER_SIGMA, drift, smear_and_sample
from cpunet.simulation.drift_maps import ELECTRON, HOLE, DriftMaps, drift_maps, in_active_volume
from cpunet.simulation.fields import FieldMaps, compute_fields
from cpunet.simulation.geometry import BoolArray, Detector, FloatArray, IntArray
from cpunet.simulation.hits import Hits, OpenHits
from cpunet.simulation.settings import SimulationSettings

# 2.355**2 times 0.12 V mm/cm, as rounded in siggen
SIGGEN_DIFFUSION = 0.67
BOLTZMANN_V_PER_K = 8.617333e-5
# siggen's self-repulsion of a cloud of 1 keV: 0.003 keV per electron-hole pair, a relative
# permittivity of 16, and its rounded FWHM per sigma
REPULSION_PER_KEV = 1.0 / 0.003 / 6.241e18 * 0.67**3 * 9e13 / 16 * 2.355**3
SMALLEST_FWHM_MM = 0.01  # initial FWHM of a cloud that grows, at least

_CHUNK = 25  # events per task of a thread
_QUICK_STRIDE = 5  # most time steps that a step of the drift of quick pulses replaces
_POINT = (0.0, 0.0, 0.0)  # a cloud without a size


def merge_hits(hits: Hits, distance_mm: float, detector: Detector | None = None) -> Hits:
    r"""Merge hits of an event that are closer together than a distance.

    Single linkage: hits connected by a chain of neighbours at most `distance_mm` apart become
    one hit with the sum of their energies at their energy-weighted mean position,

    .. math:: E = \sum_i E_i, \qquad \mathbf{x} = \frac{1}{E} \sum_i E_i \mathbf{x}_i.

    Clusters keep the order of their first hits.

    Parameters
    ----------
    hits
        Events as read or simulated.
    distance_mm
        Maximum distance between neighbours in mm. 0 merges none.
    detector
        If given, hits outside its active germanium stay as they are and come last. A hit in
        the lithium layer gives no signal. Merged with neighbours in the bulk it would give one,
        or suppress theirs: at 0.1 mm this changed the collected energy of a gamma event by
        4.5 keV on average.

    Examples
    --------
    >>> hits = Hits.of([[0, 0, 1], [0, 0, 2], [0, 0, 9]], [100, 300, 50], [0, 3])
    >>> sites = merge_hits(hits, distance_mm=1.5)
    >>> sites.z_mm, sites.edep_kev
    (array([1.75, 9.  ]), array([400.,  50.]))
    """
    if distance_mm == 0:
        return hits
    position, energy = hits.position_mm, hits.edep_kev
    alone = np.zeros(len(energy), np.bool_)
    if detector is not None:
        alone = ~detector.active(hits.r_mm, hits.z_mm)
        order = np.lexsort((alone, hits.event_of_hit))  # the last hits of each event
        position, energy, alone = position[order], energy[order], alone[order]
    near = float(distance_mm) ** 2  # always a float, so that the loop is compiled only once
    merged, offsets = _merge(position, energy, hits.offsets, alone, near)
    return Hits.of(merged[:, :3], merged[:, 3].copy(), offsets, hits.event_number)


@dataclass(frozen=True, eq=False)
class EventPulses:
    """Pulses of events, and what becomes of their hits.

    Parameters
    ----------
    waveforms
        Float32 array (n_events, samples), in units of the charge that gives a signal; zero for
        events without any signal.
    dt_ns
        Sampling period in ns.
    hits
        The events.
    valid
        Whether a hit gives a signal. Hits in a contact or its dead layer, outside the crystal
        or in germanium without a field do not.
    collected
        Whether both carriers of a hit were collected within the record.
    collection_time_ns
        Time in ns at which the last carrier of a hit was collected or the record ended; NaN if
        not valid.
    cloud_fwhm_ns
        FWHM in ns of the smearing by the charge cloud of a hit; NaN if not valid.
    trapped
        Fraction of the signal of a hit that is lost to trapping; NaN if not valid.
    lost_kev, trapped_kev
        Energy in keV of each event in hits without a signal, and of those with a signal the
        part that is lost to trapping.
    collected_kev
        Energy in keV of each event that gives a signal, which is what a detector measures.
    """

    waveforms: NDArray[np.float32]
    dt_ns: float
    hits: Hits
    valid: BoolArray
    collected: BoolArray
    collection_time_ns: FloatArray
    cloud_fwhm_ns: FloatArray
    trapped: FloatArray
    lost_kev: FloatArray
    trapped_kev: FloatArray
    collected_kev: FloatArray

    def pulses(self) -> Pulses:
        """Events with a signal as `Pulses`, with their collected energies."""
        seen = self.collected_kev > 0
        kev, numbers = self.collected_kev[seen], self.hits.event_number[seen]
        return Pulses.of(
            self.waveforms[seen], dt_ns=self.dt_ns, energy_kev=kev, event_number=numbers
        )


class Task(NamedTuple):
    """Constants of the compiled loops: cloud, steps and samples.

    The cloud starts with a FWHM of `cloud_fwhm_mm`; see `cpunet.simulation.drift` for
    `diffusion` and `repulsion_per_kev`. Its duration is a number of `whole_steps` in siggen.
    A step of the drift lasts `step_ns` and replaces `stride` time steps; `per_sample` is the
    number of steps of the drift per sample.
    """

    cloud_fwhm_mm: float
    diffusion: float
    repulsion_per_kev: float
    whole_steps: bool
    step_ns: float
    stride: int
    per_sample: int


class Simulator:
    r"""Simulates the pulses of a detector; its fields are prepared only once.

    An electron and a hole drift from the same point in explicit steps. By the Shockley-Ramo
    theorem the induced charge, in units of the charge of the hit, is the difference of the
    weighting potential :math:`\phi_w` between hole and electron,

    .. math:: S(t) = \phi_w(\mathbf{x}_h(t)) - \phi_w(\mathbf{x}_e(t)).

    The pulse is convolved with a Gaussian as long as the charge cloud takes to enter the
    contact, and averaged over each sample. Hits are simulated in parallel.

    Parameters
    ----------
    detector
        Detector, at its bias and temperature.
    settings
        Simulation settings.
    fields
        Field maps of the detector, where they are at hand.
    quick
        Whether to take longer steps, for differences between two sets of physics: their errors
        are nearly equal in both. See benchmarks/same_hits.py for accuracy and speed.

    Raises
    ------
    CpunetError
        If the detector is not fully depleted, or its grid is too fine.

    References
    ----------
    Z. He, NIM A 463 (2001) 250 (Shockley-Ramo); D. C. Radford, siggen.

    Examples
    --------
    In a planar detector of thickness :math:`d` the pulse rises by :math:`(v_e + v_h)/d`.

    >>> from types import SimpleNamespace
    >>> from cpunet.simulation.geometry_readers import read_detector
    >>> from cpunet.simulation.drift_maps import carrier_velocity, velocity_table
    >>> height = np.tile(np.arange(11.0), (11, 1))  # z in mm
    >>> planar = SimpleNamespace(
    ...     grid_mm=1.0, potential_V=100 * height, weighting_potential=1 - height / 10,
    ...     e_r_V_per_cm=0 * height, e_z_V_per_cm=0 * height - 1000,
    ...     region=np.full((11, 11), 2, np.int8))
    >>> point = SimulationSettings(dt_ns=1, length_ns=200, diffusion=False, cloud_fwhm_mm=0)
    >>> simulator = Simulator(read_detector("icpc"), point, fields=planar)  # at 90 K
    >>> pulse = simulator.signals(0.0, 0.0, [5.0], 100.0).waveforms[0]
    >>> v_e, v_h = (
    ...     abs(carrier_velocity(*velocity_table(90), carrier, 0.0, 0.0, -1000.0)[2])
    ...     for carrier in (ELECTRON, HOLE))
    >>> bool(abs(pulse[20] - 20 * (v_e + v_h) / 10) < 1e-3), round(float(pulse[-1]), 3)
    (True, 1.0)
    """

    def __init__(
        self,
        detector: Detector,
        settings: SimulationSettings,
        *,
        fields: FieldMaps | None = None,
        quick: bool = False,
    ) -> None:
        self.detector, self.settings = detector, settings
        self.fields = fields or compute_fields(detector)
        self._maps = drift_maps(self.fields, detector.temperature_K, settings)
        # FWHM² of the cloud; by the Einstein relation D/(v/E) is kT/e
        constant = settings.diffusion_constant
        if constant == "temperature":
            constant = BOLTZMANN_V_PER_K * detector.temperature_K * 10.0
        siggen = constant == "siggen"
        diffusion = SIGGEN_DIFFUSION if siggen else FWHM_PER_SIGMA**2 * float(constant)
        growing = settings.diffusion or settings.self_repulsion > 0
        steps = settings.steps_per_sample
        stride = max(n for n in range(1, _QUICK_STRIDE + 1) if steps % n == 0) if quick else 1
        self._task = Task(
            cloud_fwhm_mm=max(settings.cloud_fwhm_mm, SMALLEST_FWHM_MM if growing else 0.0),
            diffusion=diffusion if settings.diffusion else 0.0,
            repulsion_per_kev=REPULSION_PER_KEV * settings.self_repulsion,
            whole_steps=siggen,
            step_ns=stride * settings.step_ns,
            stride=stride,
            per_sample=steps // stride,
        )

    def signals(
        self, x_mm: ArrayLike, y_mm: ArrayLike, z_mm: ArrayLike, edep_kev: ArrayLike
    ) -> EventPulses:
        """Pulse of each hit, in units of its charge.

        Parameters
        ----------
        x_mm, y_mm, z_mm
            Positions of the hits in mm in the frame of the crystal.
        edep_kev
            Energies of the hits in keV. They affect only the self-repulsion of the cloud.

        Raises
        ------
        CpunetError
            If a coordinate or an energy is not finite.
        """
        columns = np.broadcast_arrays(x_mm, y_mm, z_mm, edep_kev)
        table = np.stack(columns, axis=-1).astype(np.float64).reshape(-1, 4)
        hits = Hits.of(table[:, :3], table[:, 3], np.arange(len(table) + 1))
        return self.events(hits, weighted=False)

    def events(self, hits: Hits, *, weighted: bool = True) -> EventPulses:
        r"""Pulse of each event.

        It is the energy-weighted mean of the pulses :math:`S_i` of its hits,

        .. math:: S = \frac{\sum_i E_i S_i}{\sum_i E_i (1 - t_i)},

        over all hits with a signal, with the trapped fractions :math:`t_i`. Unless `weighted`,
        it is the sum of :math:`S_i`.

        Raises
        ------
        CpunetError
            If the position or energy of a hit is not finite.
        """
        table = np.column_stack([hits.position_mm, hits.edep_kev])
        bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
        if len(bad):
            raise CpunetError(f"hits: hit {bad[0]}: no finite place or energy; leave it out")
        waveforms = np.zeros((len(hits), self.settings.n_samples), np.float32)
        facts = np.full((len(table), 4), np.nan)
        _sum_events(self._maps, table, hits.offsets, self._task, weighted, waveforms, facts)
        last_step, all_collected, fwhm_steps, trapped = facts.T
        valid = np.isfinite(last_step)
        lost_kev, trapped_kev = (
            np.bincount(hits.event_of_hit, part * hits.edep_kev, len(hits)).astype(float)
            for part in (~valid, np.where(valid, trapped, 0.0))  # integers without any hit
        )
        return EventPulses(
            waveforms=waveforms,
            dt_ns=self.settings.dt_ns,
            hits=hits,
            valid=valid,
            collected=all_collected == 1.0,
            collection_time_ns=last_step * self._task.step_ns,
            cloud_fwhm_ns=fwhm_steps * self._task.step_ns,
            trapped=trapped,
            lost_kev=lost_kev,
            trapped_kev=trapped_kev,
            collected_kev=hits.energy_kev - lost_kev - trapped_kev,
        )

    def blocks(self, source: OpenHits, title: str) -> Iterator[tuple[int, EventPulses]]:
        """Pulses of the events of a source, block by block, shown under a `title`.

        Hits are merged within `SimulationSettings.cluster_mm`; their number before comes with
        each block.
        """
        with stage(title, source.n_events) as bar:
            for hits in source.blocks:
                distance = 0.0 if source.merged else self.settings.cluster_mm
                yield len(hits.edep_kev), self.events(merge_hits(hits, distance, self.detector))
                bar.update(len(hits))

    def paths(
        self, x_mm: ArrayLike, y_mm: ArrayLike, z_mm: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Trajectories of both carriers from each starting point in mm.

        Returns
        -------
        electrons, holes
            Positions (n, steps, 3) in mm at each step; NaN after collection.
        """
        start = np.stack(np.broadcast_arrays(x_mm, y_mm, z_mm), axis=-1).astype(np.float64)
        start = start.reshape(-1, 3)
        settings = self.settings
        n_steps, step_ns = settings.n_samples * settings.steps_per_sample, settings.step_ns
        paths, signal = np.full((2, len(start), n_steps, 3), np.nan), np.zeros(n_steps)
        for i, (x, y, z) in enumerate(start.tolist()):
            if in_active_volume(self._maps, x, y, z):
                for carrier in (ELECTRON, HOLE):
                    path = paths[carrier, i]
                    drift(self._maps, carrier, (x, y, z), step_ns, 1, _POINT, signal, path)
        return paths[ELECTRON], paths[HOLE]


@kernel(parallel=True)
def _sum_events(
    maps: DriftMaps,
    hits: FloatArray,
    offsets: IntArray,
    task: Task,
    weighted: bool,
    waveforms: NDArray[np.float32],
    facts: FloatArray,
) -> None:
    """Fill the pulses of events, and the facts of hits with a signal.

    Pulses are means weighted by energy, or sums unless `weighted`. The facts are the last step,
    whether all charge is collected, the FWHM in steps of the smearing by the cloud, and the
    fraction trapped.
    """
    n_events, n_samples = waveforms.shape
    # work arrays are shared by a chunk of events
    for chunk in prange((n_events + _CHUNK - 1) // _CHUNK):
        out, no_path = np.empty(n_samples), np.empty((0, 3))
        signal = np.empty(n_samples * task.per_sample)
        for event in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n_events)):
            out[:] = 0.0
            collected = trapped = 0.0
            for i in range(offsets[event], offsets[event + 1]):
                x, y, z, energy = hits[i, 0], hits[i, 1], hits[i, 2], hits[i, 3]
                if not in_active_volume(maps, x, y, z):
                    continue
                signal[:] = 0.0
                start = (x, y, z)
                cloud = (task.cloud_fwhm_mm, task.diffusion, task.repulsion_per_kev * energy)
                steps_e, arrived_e, _, _, trapped_e = drift(
                    maps, ELECTRON, start, task.step_ns, task.stride, _POINT, signal, no_path
                )
                steps_h, arrived_h, size, speed, trapped_h = drift(
                    maps, HOLE, start, task.step_ns, task.stride, cloud, signal, no_path
                )
                fwhm = 0.0
                if size > 0.0 and speed > 0.0:
                    fwhm = size / (speed * task.step_ns)
                    if task.whole_steps:
                        fwhm = float(int(1.5 + fwhm))
                        fwhm = fwhm if fwhm > 1.0 else 0.0
                if task.stride > 1:  # means over the time steps that a step replaces
                    later = (task.stride - 1) / (2 * task.stride)
                    for k in range(len(signal) - 1):
                        signal[k] += later * (signal[k + 1] - signal[k])
                last, sigma = max(steps_e, steps_h), fwhm / FWHM_PER_SIGMA
                weight = energy if weighted else 1.0
                smear_and_sample(signal, task.per_sample, sigma, last, weight, out)
                facts[i, 0], facts[i, 1] = last, 1.0 if arrived_e and arrived_h else 0.0
                facts[i, 2], facts[i, 3] = fwhm, trapped_e + trapped_h
                collected += energy
                trapped += energy * facts[i, 3]
            scale = collected - trapped if weighted else 1.0
            if scale > 0.0:
                for j in range(n_samples):
                    waveforms[event, j] = out[j] / scale


@kernel
def _merge(
    position: FloatArray, energy: FloatArray, offsets: IntArray, alone: BoolArray, near2: float
) -> tuple[FloatArray, IntArray]:
    """Clusters as rows (x, y, z, energy), and the offsets of the events."""
    merged = np.zeros((len(energy), 4))
    new_offsets = np.zeros_like(offsets)
    label = np.empty(len(energy), np.int64)
    queue = np.empty(len(energy), np.int64)
    n = 0
    for event in range(len(offsets) - 1):
        start, end = offsets[event], offsets[event + 1]
        label[start:end] = -1
        for first in range(start, end):
            if label[first] >= 0:
                continue
            label[first] = n
            queue[0] = first
            done, waiting = 0, 1
            while done < waiting and not alone[first]:
                mine = queue[done]
                done += 1
                for other in range(first + 1, end):
                    if label[other] >= 0 or alone[other]:
                        continue
                    square = 0.0
                    for axis in range(3):
                        square += (position[mine, axis] - position[other, axis]) ** 2
                    if square <= near2:
                        label[other] = n
                        queue[waiting] = other
                        waiting += 1
            row = merged[n]
            for member in queue[:waiting]:
                row[3] += energy[member]
            for axis in range(3):
                # relative to the first, so that equal positions are preserved exactly
                origin = position[first, axis]
                shift = 0.0
                for member in queue[:waiting]:
                    shift += energy[member] * (position[member, axis] - origin)
                row[axis] = origin + (shift / row[3] if row[3] > 0.0 else 0.0)
            n += 1
        new_offsets[event + 1] = n
    return merged[:n], new_offsets
