"""The two sides of a test stand: independent events, each with its detector and settings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from cpunet.electronics.chain import Electronics
from cpunet.errors import CpunetError
from cpunet.progress import stage
from cpunet.pulses.container import Pulses
from cpunet.simulation.clustering import merge_hits
from cpunet.simulation.events import simulate_events
from cpunet.simulation.fields import FieldMaps, compute_fields
from cpunet.simulation.gammas.sample import EnergyWindow
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_sources import GammaSource
from cpunet.simulation.hits import Hits
from cpunet.simulation.library import build_library
from cpunet.simulation.library_lookup import PulseLibrary
from cpunet.simulation.settings import Shift, SimulationSettings

Labels = npt.NDArray[np.int64]

LABELS = {"DEP": 0, "SEP": 1, "FEP": 2}
OTHER = 3
# Period of the simulated pulses at the input of the chain; same as that of the library.
_FINE_NS = 4.0


@dataclass(frozen=True)
class Side:
    """One side of a stand: its detector, settings of the simulation, and source of events."""

    detector: Detector
    settings: SimulationSettings
    source: GammaSource

    def provenance(self) -> dict[str, Any]:
        """Detector, settings and hits, for ``stand.json``."""
        return {
            "detector": self.detector.model_dump(mode="json"),
            "settings": self.settings.model_dump(mode="json"),
            "hits": self.source.provenance(),
        }

    def _fields(self) -> FieldMaps:
        with stage(f"Fields of {self.detector.name}"):
            return compute_fields(self.detector)

    def library(self) -> PulseLibrary:
        """Pre-computed pulses."""
        return build_library(self._fields(), self.settings)

    def blocks(
        self, title: str, library: PulseLibrary | None
    ) -> Iterator[tuple[Pulses, Labels, Hits]]:
        """Finely sampled pulses, their lines and their hits, block by block.

        Energies are calibrated as in a measurement: a factor, determined from the lines in the
        first block, corrects the median loss by charge trapping.

        Raises
        ------
        CpunetError
            If no event gives a signal.
        """
        fields = self._fields()
        opened = self.source.open(self.detector)
        gain = 0.0
        with stage(title, opened.n_events) as bar:
            for hits in opened.blocks:
                merged = merge_hits(hits, self.detector, self.settings.cluster_mm)
                events = simulate_events(fields, merged, self.settings, library)
                kept = events.collected_kev > 0
                pulses = events.pulses()
                if len(pulses):
                    untrapped = pulses.energy_kev + events.trapped_kev[kept]
                    labels = labels_of(untrapped, self.source.events)
                    gain = gain or _calibration(untrapped / pulses.energy_kev, labels)
                    calibrated = replace(pulses, energy_kev=gain * pulses.energy_kev)
                    yield calibrated, labels, merged[kept]
                bar.update(len(hits))
        if not gain:
            raise CpunetError(
                f"none of {opened.n_events} events gives a signal in {self.detector.name}; "
                "give more `events`"
            )


def stand_sides(
    electronics: Electronics,
    detector: Detector,
    events: Mapping[EnergyWindow, int],
    *,
    shift: Shift | None = None,
    settings: SimulationSettings | None = None,
    seed: int = 0,
) -> tuple[Side, Side, int]:
    """Sides of the simulation and of the data, and the seed of the readout.

    Parameters
    ----------
    electronics
        Readout chain of the data and of the truth.
    detector, settings
        Detector and settings of the simulation.
    events
        Number of events of each side by window.
    shift
        Deviations of the data's detector from the simulated one; None for the same detector.
    seed
        Seed of all random numbers.

    Raises
    ------
    CpunetError
        If a window has no events, the chain's period is not a multiple of that of the
        pulses, the settings have another period, or the shifted detector is not valid.
    """
    for window, number in events.items():
        if number < 1:
            raise CpunetError(f"`events` {window.name}={number}: give at least 1 event")
    settings = _finely_sampled(settings or SimulationSettings(), electronics)
    # seeds of the events of both sides and of the readout
    sim_seed, data_seed, readout_seed = map(
        int, np.random.SeedSequence(seed).generate_state(3, np.uint32)
    )
    sim_hits, data_hits = (
        GammaSource(events, settings.source_height_mm, settings.source_radius_mm, s)
        for s in (sim_seed, data_seed)
    )
    sim = Side(detector, settings, sim_hits)
    data = Side(
        detector if shift is None else shift.detector(detector),
        settings if shift is None else shift.settings(settings),
        data_hits,
    )
    return sim, data, readout_seed


def labels_of(energy_kev: npt.NDArray[np.float64], windows: Iterable[EnergyWindow]) -> Labels:
    """Labels by energy window: 0 DEP, 1 SEP, 2 FEP, 3 other; collected energies in keV."""
    labels = np.full(len(energy_kev), OTHER)
    for window in windows:
        # sums of deposits are rounded
        inside = (energy_kev >= window.low_kev - 1e-6) & (energy_kev <= window.high_kev + 1e-6)
        labels[inside] = LABELS.get(window.name, OTHER)
    return labels


def _calibration(share: npt.NDArray[np.float64], labels: Labels) -> float:
    """Median over the pulses in lines, or over all if none is in a line."""
    of_lines = labels != OTHER
    return float(np.median(share[of_lines] if of_lines.any() else share))


def _finely_sampled(
    settings: SimulationSettings, electronics: Electronics
) -> SimulationSettings:
    """Settings with the period of the pulses of a stand, of which the chain's is a multiple."""
    ratio = electronics.dt_ns / _FINE_NS
    if abs(ratio - round(ratio)) > 1e-9:
        raise CpunetError(
            f"electronics {electronics.name}: dt_ns = {electronics.dt_ns:g} is no multiple of "
            f"{_FINE_NS:g}, the pulses' period; choose another"
        )
    if "dt_ns" in settings.model_fields_set and settings.dt_ns != _FINE_NS:
        raise CpunetError(
            f"settings: dt_ns = {settings.dt_ns:g}: the pulses of a stand have the chain's "
            "period; leave dt_ns out"
        )
    try:
        return SimulationSettings.model_validate(settings.model_dump() | {"dt_ns": _FINE_NS})
    except ValidationError as error:
        raise CpunetError(
            f"settings: step_ns = {settings.step_ns:g} does not divide the {_FINE_NS:g} ns of "
            "a stand's pulses; give one that does"
        ) from error
