"""Counts of a simulation, and the time spent on each of its steps."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from cpunet.jobs.simulation.hit_sources import Window
from cpunet.simulation.events import EventPulses
from cpunet.simulation.geometry import LI_CONTACT, POINT_CONTACT, Detector
from cpunet.simulation.hits import Hits


@dataclass
class Summary:
    """Counts over all events; hits are counted as merged, energies in keV.

    ``lines`` counts, by window, the pulses whose collected energy is still in it;
    ``not_collected`` the hits whose charge was not all collected within the record;
    ``seconds`` is the time spent on each step.
    """

    mode: str = ""
    n_events: int = 0
    n_written: int = 0
    hits_before_merging: int = 0
    hits: int = 0
    hits_outside: int = 0
    hits_in_contacts: int = 0
    not_collected: int = 0
    energy_kev: float = 0.0
    lost_kev: float = 0.0
    trapped_kev: float = 0.0
    events_with_loss: int = 0
    lines: Counter[str] = field(default_factory=Counter)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def without_signal(self) -> int:
        """Number of events that were not written because none of their hits gives a signal."""
        return self.n_events - self.n_written

    def add(
        self,
        detector: Detector,
        hits: Hits,
        events: EventPulses,
        windows: tuple[Window, ...],
    ) -> None:
        """Count a block of events."""
        r = np.hypot(hits.x_mm, hits.y_mm)
        inside = detector.inside(r, hits.z_mm)
        contacts = np.isin(detector.region(r, hits.z_mm), (POINT_CONTACT, LI_CONTACT))
        collected = events.collected_kev
        self.n_events += len(hits)
        self.n_written += int((collected > 0).sum())
        self.hits += len(hits.edep_kev)
        self.hits_outside += int((~inside).sum())
        self.hits_in_contacts += int((inside & contacts).sum())
        self.not_collected += events.counts["hits not collected within the record"]
        self.energy_kev += float(events.energy_kev.sum())
        self.lost_kev += float(events.lost_kev.sum())
        self.trapped_kev += float(events.trapped_kev.sum())
        self.events_with_loss += int((events.lost_kev > 0).sum())
        for window in windows:
            within = (collected >= window.low_kev) & (collected <= window.high_kev)
            self.lines[window.name] += int(within.sum())


class Clock:
    """Time spent on each step, in seconds."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Add the time since the last lap, or the start, to that of a step."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now
