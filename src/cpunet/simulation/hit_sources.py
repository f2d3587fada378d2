"""Sources of hits, read block by block: a file or the gamma Monte Carlo."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.errors import CpunetError
from cpunet.simulation.energy_windows import Window
from cpunet.simulation.gammas import GammaStatistics, WantedLine, simulate_gammas
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_readers import TIME_WINDOW_US, Transform, hit_parts
from cpunet.simulation.hit_readers.steps import require_some
from cpunet.simulation.hits import Hits

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


@dataclass(frozen=True)
class HitFile:
    """Hits of a file, see `cpunet.simulation.hit_readers.read_hits`.

    With `windows`, only events with a deposited energy in one of them are used.  `placed` hits
    are those of a simulation: they have been checked against the crystal and merged.
    """

    path: Path
    table: str | None = None
    transform: Transform = field(default_factory=Transform)
    length_unit: str | None = None
    energy_unit: str | None = None
    windows: tuple[Window, ...] = ()
    placed: bool = False
    time_window_us: float = TIME_WINDOW_US

    def open(self, detector: Detector) -> OpenHits:
        """Read the file.

        Raises
        ------
        CpunetError
            If the hits cannot be read, no event is in a window, or nearly all hits are outside
            the crystal.
        """
        parts = hit_parts(
            self.path,
            detector=self.table,
            transform=self.transform,
            length_unit=self.length_unit,
            energy_unit=self.energy_unit,
            time_window_us=self.time_window_us,
        )

        def chosen() -> Iterator[Hits]:
            for hits in parts():
                within = _in_windows(hits.energy_kev, self.windows) if self.windows else None
                yield hits if within is None else hits[within]

        n_events, astray = 0, _Astray(detector)
        for hits in chosen():
            n_events += hits.n_events
            if not self.placed:
                astray.add(hits)
        if not n_events and self.windows:
            names = ", ".join(window.name for window in self.windows)
            raise CpunetError(f"{self.path}: no event in {names}; widen window_kev")
        require_some(self.path, n_events)
        warning = "" if self.placed else astray.told(self.path)
        return OpenHits(n_events, _regrouped(chosen(), BLOCK_EVENTS), warning)

    def provenance(self) -> dict[str, Any]:
        """Provenance of the hits, for the output."""
        return {
            "file": str(self.path),
            "table": self.table,
            "origin_mm": list(self.transform.origin_mm),
            "flip_z": self.transform.flip_z,
            "time_window_us": self.time_window_us,
            "windows_kev": _by_name(self.windows),
        }


@dataclass
class _Astray:
    """Hits that lie outside the crystal, counted part by part."""

    detector: Detector
    outside: int = 0
    total: int = 0
    spans: dict[str, tuple[float, float]] = field(default_factory=dict)

    def add(self, hits: Hits) -> None:
        """Count the hits of a part."""
        inside = self.detector.inside(np.hypot(hits.x_mm, hits.y_mm), hits.z_mm)
        self.outside += int((~inside).sum())
        self.total += len(inside)
        for axis, values in zip("xyz", (hits.x_mm, hits.y_mm, hits.z_mm), strict=True):
            if len(values):
                low, high = self.spans.get(axis, (np.inf, -np.inf))
                self.spans[axis] = min(low, values.min()), max(high, values.max())

    def told(self, path: Path) -> str:
        """Return a warning, or an empty text; raise an error if nearly all hits are outside."""
        n, total, detector = self.outside, self.total, self.detector
        if n <= _STRAY * total:
            return ""
        spans = (f"{axis} {low:.4g} to {high:.4g}" for axis, (low, high) in self.spans.items())
        share = f"all {total}" if n == total else f"{n} of {total} ({n / total:.1%})"
        text = (
            f"{path}: {share} hits lie outside {detector.name} "
            f"(radius {detector.crystal_radius:g}, z 0 to {detector.crystal_length:g} mm); "
            f"they span {', '.join(spans)} mm; "
        )
        if n > _MISPLACED * total:
            raise CpunetError(
                f"{text}move them with `origin` and `flip_z`, or choose others with "
                "`hits_detector`"
            )
        return f"{text}their energy is lost; check `origin`, `flip_z` and `hits_detector`"


def _regrouped(parts: Iterator[Hits], size: int) -> Iterator[Hits]:
    """The same events in blocks of `size`; the last block can be shorter."""
    left: Hits | None = None
    for part in parts:
        hits = part if left is None else Hits.concatenate([left, part])
        whole = hits.n_events // size * size
        for start in range(0, whole, size):
            yield hits[start : start + size]
        left = hits[whole:] if whole < hits.n_events else None
    if left is not None:
        yield left


@dataclass(frozen=True)
class GammaSource:
    """Events of the built-in Monte Carlo, a given number in each energy window.

    The source is a disc of radius `radius_mm`, `height_mm` above the top of the crystal, see
    `cpunet.simulation.gammas.simulate_gammas`.
    """

    windows: tuple[Window, ...]
    events: tuple[int, ...]
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
        total = sum(self.events)
        if total < 1:
            raise CpunetError("`events`: no event is wanted; give at least 1")
        return OpenHits(total, self._blocks(detector, -(-total // _ROUND_EVENTS)))

    def provenance(self) -> dict[str, Any]:
        """Provenance of the hits, for the output."""
        return {
            "monte_carlo": "Tl-208, 2614.511 keV",
            "windows_kev": _by_name(self.windows),
            "events": {w.name: n for w, n in zip(self.windows, self.events, strict=True)},
            "source_height_mm": self.height_mm,
            "source_radius_mm": self.radius_mm,
            "seed": self.seed,
        }

    def _blocks(self, detector: Detector, rounds: int) -> Iterator[Hits]:
        """Run rounds in parallel, at most one per core, and yield their hits in order.

        Each round has its own seed, so the events do not depend on the number of cores.
        """
        seeds = np.random.SeedSequence(self.seed).generate_state(rounds, np.uint64)
        has_affinity = hasattr(os, "sched_getaffinity")
        cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
        workers = min(cores, _MAX_WORKERS, rounds)
        waiting: deque[Future[tuple[Hits, GammaStatistics]]] = deque()
        pool = ThreadPoolExecutor(workers)
        primaries = 0
        try:
            for i in range(rounds + workers):
                if i < rounds:
                    waiting.append(pool.submit(self._round, detector, i, rounds, int(seeds[i])))
                if i >= workers:
                    hits, statistics = waiting.popleft().result()
                    yield replace(hits, event_number=hits.event_number + primaries)
                    primaries += statistics.n_primaries
        finally:
            pool.shutdown(cancel_futures=True)

    def _round(
        self, detector: Detector, i: int, rounds: int, seed: int
    ) -> tuple[Hits, GammaStatistics]:
        wanted = {
            w.name: WantedLine(w.low_kev, w.high_kev, n * (i + 1) // rounds - n * i // rounds)
            for w, n in zip(self.windows, self.events, strict=True)
        }
        return simulate_gammas(
            detector,
            source_height_mm=self.height_mm,
            source_radius_mm=self.radius_mm,
            n_primaries=_GAMMAS_PER_EVENT * sum(line.events for line in wanted.values()),
            seed=seed,
            wanted=wanted,
        )


@dataclass(frozen=True, eq=False)
class OpenHits:
    """Number of events, a single-use iterator over blocks of them, and a warning or ``""``."""

    n_events: int
    blocks: Iterator[Hits]
    warning: str = ""


HitSource = HitFile | GammaSource


def _in_windows(energy_kev: Any, windows: tuple[Window, ...]) -> Any:
    # sums of deposits are rounded, in some formats to float32; windows are wider than that
    inside = [(energy_kev >= w.low_kev) & (energy_kev <= w.high_kev) for w in windows]
    return np.logical_or.reduce(inside)


def _by_name(windows: tuple[Window, ...]) -> dict[str, tuple[float, float]]:
    return {window.name: (window.low_kev, window.high_kev) for window in windows}
