"""Sources of hits in windows of energy, block by block: a file or the gamma Monte Carlo."""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.processes import usable_cores
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import PeakConfig
from cpunet.simulation.gammas.sample import EnergyWindow, simulate_gammas
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_files import WINDOW_US, read_hits
from cpunet.simulation.hits import HitOptions, Hits, OpenHits

log = logging.getLogger(__name__)

BLOCK_EVENTS = 2000
# Events per round of the Monte Carlo, and maximum number of gammas per event; the rarest
# windows, 1 keV of the continuum, need about ten thousand.
_ROUND_EVENTS = 1000
_GAMMAS_PER_EVENT = 100_000
# Each running round holds about ten MB of hits.
_MAX_WORKERS = 8
# Shares of hits outside the crystal: up to the first, rounding at its surface can be the
# reason; above the second, the hits are not those of this detector.
_STRAY, _MISPLACED = 1e-3, 0.9


def energy_windows(
    text: str, peaks: Mapping[str, PeakConfig], half_width_kev: float
) -> list[EnergyWindow]:
    """Windows from ``"FEP,DEP"`` or ranges in keV such as ``"1500-1580"``.

    Parameters
    ----------
    text
        Names and ranges, separated by commas.
    peaks
        Gamma lines.
    half_width_kev
        Half-width of the windows around the lines.

    Raises
    ------
    CpunetError
        If a part is neither a line of `peaks` nor a range.

    Examples
    --------
    >>> lines = {"FEP": PeakConfig(energy_kev=2614.5, half_width_kev=5)}
    >>> [tuple(window) for window in energy_windows("FEP,1500-1580", lines, 0.5)]
    [('FEP', 2614.0, 2615.0), ('1500-1580', 1500.0, 1580.0)]
    """
    windows = []
    for name in (part.strip() for part in text.split(",")):
        chosen = parse_selection(name, peaks)
        if chosen.chosen:
            line = peaks[name].energy_kev
            windows.append(EnergyWindow(name, line - half_width_kev, line + half_width_kev))
        else:
            windows.append(EnergyWindow(name, *chosen.ranges_kev[0]))
    return windows


def wanted_events(
    events: str | Mapping[str, int], peaks: Mapping[str, PeakConfig], half_width_kev: float
) -> dict[EnergyWindow, int]:
    """Windows, and the events wanted in each.

    Parameters
    ----------
    events
        ``"FEP=4000,1500-1580=300"``, the same as a mapping, or a number for each of `peaks`.
    peaks, half_width_kev
        See `energy_windows`.

    Raises
    ------
    CpunetError
        If a number or a line cannot be understood, or a line is named twice.

    Examples
    --------
    >>> lines = {"FEP": PeakConfig(energy_kev=2614.5, half_width_kev=5)}
    >>> list(wanted_events("FEP=10,1500-1580=5", lines, 0.5).values())
    [10, 5]
    """
    if isinstance(events, str):
        pairs = [part.partition("=")[::2] for part in events.split(",")]
        if "=" not in events:
            pairs = [(name, events) for name in peaks]
    else:
        pairs = [(name, str(number)) for name, number in events.items()]
    names = [name.strip() for name, _ in pairs]
    if len(set(names)) < len(names):
        raise CpunetError(f"`events` {events}: names a peak twice; give each once")
    windows = energy_windows(",".join(names), peaks, half_width_kev)
    for _, number in pairs:
        # underscores and signs, which int() takes, are more likely slips
        if not re.fullmatch(r"\s*\d{1,9}\s*", number):
            raise CpunetError(
                f"`events`: {number[:60]!r} is no number of events; give N or FEP=N,DEP=M"
            )
    return {window: int(number) for window, (_, number) in zip(windows, pairs, strict=True)}


@dataclass(frozen=True)
class HitFile:
    """Hits of a file, see `cpunet.simulation.hit_files.read_hits`.

    With `windows`, only events with a deposited energy within them are used.  `placed` hits
    are those of a simulation: they have been checked against the crystal and merged.
    """

    path: Path
    options: HitOptions = field(default_factory=HitOptions)
    windows: tuple[EnergyWindow, ...] = ()
    placed: bool = False

    def open(self, detector: Detector) -> OpenHits:
        """Read the file.

        Raises
        ------
        CpunetError
            If the hits cannot be read, no event is in a window, or nearly all hits are outside
            the crystal.
        """
        hits = read_hits(self.path, self.options)
        if self.windows:
            # sums of deposits are rounded, in some formats to float32; windows are wider
            energy = hits.energy_kev
            inside = [(energy >= w.low_kev) & (energy <= w.high_kev) for w in self.windows]
            hits = hits[np.logical_or.reduce(inside)]
        if not len(hits):
            names = ", ".join(window.name for window in self.windows)
            raise CpunetError(f"{self.path}: no event in {names}; widen window_kev")
        outside = 0 if self.placed else int((~detector.inside(hits.r_mm, hits.z_mm)).sum())
        total = len(hits.edep_kev)
        if outside > _STRAY * total:
            place = hits.position_mm
            ends = zip("xyz", place.min(axis=0), place.max(axis=0), strict=True)
            spans = (f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in ends)
            share = f"{outside} of {total} ({outside / total:.1%})"
            text = (
                f"{self.path}: {share if outside < total else f'all {total}'} hits lie outside "
                f"{detector.name} (radius {detector.crystal_radius:g}, z 0 to "
                f"{detector.crystal_length:g} mm); they span {', '.join(spans)} mm; "
            )
            if outside > _MISPLACED * total:
                raise CpunetError(
                    f"{text}move them with `origin` and `flip_z`, or choose others with "
                    "`hits_detector`"
                )
            log.warning(
                f"{text}their energy is lost; check `origin`, `flip_z` and `hits_detector`"
            )
        starts = range(0, len(hits), BLOCK_EVENTS)
        blocks = (hits[i : i + BLOCK_EVENTS] for i in starts)
        return OpenHits(len(hits), blocks, merged=self.placed)

    def provenance(self) -> dict[str, Any]:
        """Provenance of the hits, for the output."""
        return {
            "file": str(self.path),
            "table": self.options.hits_detector,
            "origin_mm": list(self.options.origin),
            "flip_z": self.options.flip_z,
            "time_window_us": WINDOW_US,
            "windows_kev": {w.name: (w.low_kev, w.high_kev) for w in self.windows},
        }


@dataclass(frozen=True)
class GammaSource:
    """Events of the built-in Monte Carlo, a given number in each energy window.

    The source is a disc of radius `radius_mm`, `height_mm` above the top of the crystal, see
    `cpunet.simulation.gammas.simulate_gammas`.
    """

    events: Mapping[EnergyWindow, int]
    height_mm: float
    radius_mm: float
    seed: int

    def open(self, detector: Detector) -> OpenHits:
        """Start the Monte Carlo.

        Raises
        ------
        CpunetError
            If no event is requested; during iteration, if `simulate_gammas` fails.
        """
        total = sum(self.events.values())
        if total < 1:
            raise CpunetError("`events`: no event is wanted; give at least 1")
        return OpenHits(total, self._blocks(detector, -(-total // _ROUND_EVENTS)))

    def provenance(self) -> dict[str, Any]:
        """Provenance of the hits, for the output."""
        return {
            "monte_carlo": "Tl-208, 2614.511 keV",
            "windows_kev": {w.name: (w.low_kev, w.high_kev) for w in self.events},
            "events": {window.name: n for window, n in self.events.items()},
            "source_height_mm": self.height_mm,
            "source_radius_mm": self.radius_mm,
            "seed": self.seed,
        }

    def _blocks(self, detector: Detector, rounds: int) -> Iterator[Hits]:
        """Run rounds in parallel, at most one per core, and yield their hits in order.

        Each round has its own seed, so the events do not depend on the number of cores.
        """
        seeds = np.random.SeedSequence(self.seed).generate_state(rounds, np.uint64)

        def events_of(i: int) -> tuple[Hits, int]:
            wanted = {
                w: n * (i + 1) // rounds - n * i // rounds for w, n in self.events.items()
            }
            return simulate_gammas(
                detector,
                source_height_mm=self.height_mm,
                source_radius_mm=self.radius_mm,
                n_primaries=_GAMMAS_PER_EVENT * sum(wanted.values()),
                seed=int(seeds[i]),
                wanted=wanted,
            )

        ahead = min(usable_cores(), _MAX_WORKERS, rounds)
        pool, primaries = ThreadPoolExecutor(ahead), 0
        waiting = deque(pool.submit(events_of, i) for i in range(ahead))
        try:
            for later in range(ahead, rounds + ahead):
                hits, n_primaries = waiting.popleft().result()
                if later < rounds:
                    waiting.append(pool.submit(events_of, later))
                yield replace(hits, event_number=hits.event_number + primaries)
                primaries += n_primaries
        finally:
            pool.shutdown(cancel_futures=True)
