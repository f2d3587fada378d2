"""Simulate the pulses of hits in a detector: hits of a file, or of the gamma Monte Carlo."""

from __future__ import annotations

import json
import logging
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.outputs import refuse_inputs
from cpunet.processes import usable_cores
from cpunet.pulses.peaks import Peaks, parse_selection
from cpunet.pulses.provenance import MADE_BY, SIMULATION
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes import load_recipe
from cpunet.settings import Set, require_seed
from cpunet.simulation.gammas import EnergyWindow, simulate_gammas
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_files import HIT_TABLE, hit_columns, read_hits
from cpunet.simulation.hit_steps import WINDOW_US
from cpunet.simulation.hits import HitOptions, Hits, OpenHits
from cpunet.simulation.outline import LI_CONTACT, POINT_CONTACT, places
from cpunet.simulation.settings import SimulationSettings, detector_and_settings
from cpunet.simulation.simulator import EventPulses, Simulator

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
    names: str | Iterable[str], peaks: Peaks, half_width_kev: float
) -> list[EnergyWindow]:
    """Windows from ``"FEP,DEP"`` or ranges in keV such as ``"1500-1580"``.

    Parameters
    ----------
    names
        Names and ranges, in a text separated by commas.
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
    >>> from cpunet.recipes.schema import PeakConfig
    >>> lines = {"FEP": PeakConfig(energy_kev=2614.5, half_width_kev=5)}
    >>> [tuple(window) for window in energy_windows("FEP,1500-1580", lines, 0.5)]
    [('FEP', 2614.0, 2615.0), ('1500-1580', 1500.0, 1580.0)]
    """
    windows = []
    for name in map(str.strip, names.split(",") if isinstance(names, str) else names):
        chosen = parse_selection(name, peaks)
        if chosen.chosen:
            line = peaks[name].energy_kev
            windows.append(EnergyWindow(name, line - half_width_kev, line + half_width_kev))
        else:
            windows.append(EnergyWindow(name, *chosen.ranges_kev[0]))
    return windows


def wanted_events(
    events: str | Mapping[str, int], peaks: Peaks, half_width_kev: float
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
    >>> from cpunet.recipes.schema import PeakConfig
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
    windows = energy_windows(names, peaks, half_width_kev)
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
        total, place = len(hits.edep_kev), hits.position_mm
        if outside > _STRAY * total:
            ends = zip("xyz", place.min(axis=0), place.max(axis=0), strict=True)
            spans = (f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in ends)
            share = f"{outside} of {total} ({outside / total:.1%})"
            text = (
                f"{self.path}: {share if outside < total else f'all {total}'} hits lie outside "
                f"{detector.name} (radius {detector.crystal_radius:g}, z 0 to "
                f"{detector.crystal_length:g} mm); they span {', '.join(spans)} mm; "
            )
            if outside > _MISPLACED * total:
                where = "with `origin` and `flip_z`, or choose others with `hits_detector`"
                raise CpunetError(f"{text}move them {where}")
            check = "`origin`, `flip_z` and `hits_detector`"
            log.warning(f"{text}their energy is lost; check {check}")
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
        place = {"source_height_mm": self.height_mm, "source_radius_mm": self.radius_mm}

        def events_of(i: int) -> tuple[Hits, int]:
            share = {w: n * (i + 1) // rounds - n * i // rounds for w, n in self.events.items()}
            most = _GAMMAS_PER_EVENT * sum(share.values())
            return simulate_gammas(
                detector, n_primaries=most, seed=int(seeds[i]), wanted=share, **place
            )

        at_once, primaries = min(usable_cores(), _MAX_WORKERS, rounds), 0
        with ThreadPoolExecutor(at_once) as pool:
            for first in range(0, rounds, at_once):
                numbers = range(first, min(first + at_once, rounds))
                for hits, n_primaries in pool.map(events_of, numbers):
                    yield replace(hits, event_number=hits.event_number + primaries)
                    primaries += n_primaries


@dataclass(repr=False)
class Simulation:
    """A file of simulated pulses, with counts over all of its events.

    `counts` are those of events, of hits as merged, and sums of energies in keV.
    ``hits_not_collected`` are hits whose charge was not all collected within the record.
    `lines` counts, by window, the pulses whose collected energy is still in it.
    """

    path: Path
    detector: Detector
    settings: SimulationSettings
    windows: list[EnergyWindow]
    counts: Counter[str] = field(default_factory=Counter)
    lines: Counter[str] = field(default_factory=Counter)

    @property
    def pulses(self) -> PulseFile:
        """The pulses, in their file."""
        return PulseFile(self.path)

    def count(self, before_merging: int, events: EventPulses) -> None:
        """Count a block of events, and its hits before they were merged."""
        hits, collected = events.hits, events.collected_kev
        region, inside = places(self.detector, hits.r_mm, hits.z_mm)
        contacts = np.isin(region, (POINT_CONTACT, LI_CONTACT))
        block: dict[str, Any] = {
            "events": len(hits),
            "events_written": int((collected > 0).sum()),
            "events_without_signal": int((collected <= 0).sum()),
            "events_with_loss": int((events.lost_kev > 0).sum()),
            "hits_before_merging": before_merging,
            "hits": len(hits.edep_kev),
            "hits_outside": int((~inside).sum()),
            "hits_in_contacts": int((inside & contacts).sum()),
            "hits_not_collected": int((events.valid & ~events.collected).sum()),
            "energy_kev": float(hits.energy_kev.sum()),
            "lost_kev": float(events.lost_kev.sum()),
            "trapped_kev": float(events.trapped_kev.sum()),
        }
        self.counts.update(block)  # adds them
        for name, low, high in self.windows:
            self.lines[name] += int(((collected >= low) & (collected <= high)).sum())

    def __repr__(self) -> str:
        n = self.counts["events_written"]
        return f"<Simulation {self.path}: {n} pulses of {self.detector.name}>"

    def __str__(self) -> str:
        n, total = self.counts, self.counts["energy_kev"]
        lines = ", ".join(f"{number} {name}" for name, number in self.lines.items())
        text = [
            f"{n['events_written']} of {n['events']} events written ({lines} by collected "
            f"energy); {n['events_without_signal']} without any signal",
            f"{n['hits']} hits ({n['hits_before_merging']} before merging): "
            f"{n['hits_in_contacts']} in contacts and the lithium layer, "
            f"{n['hits_outside']} outside the crystal",
            f"{n['lost_kev'] / total:.2%} of the energy lost there, in "
            f"{n['events_with_loss']} events",
        ]
        if late := n["hits_not_collected"]:
            text.append(f"{late} hits not collected in full; raise length_ns")
        if n["trapped_kev"]:
            text.append(f"{n['trapped_kev'] / total:.2%} of the energy trapped")
        return "\n".join(f"{self.path}: {line}" for line in text)


def simulate(
    out: str | Path,
    *,
    detector: str | Path | Detector = "icpc",
    events: str | Mapping[str, int] | None = None,
    hits: str | Path | HitFile | None = None,
    frame: HitOptions = HitOptions(),
    settings: Set = (),
    seed: int = 0,
    force: bool = False,
) -> Simulation:
    """Simulate pulses of a detector, from hits of a file or of Tl-208 gammas.

    The table ``geds/sim`` of the file holds ``waveform`` in units of the collected charge,
    collected ``energy`` (keV), ``event_number``, ``lost_energy`` (keV, deposited where it gives
    no signal), ``n_hits`` and, with trapping, ``trapped_energy`` (keV, deposited elsewhere but
    not collected). Its attribute ``simulation`` is the provenance in JSON. ``geds/hits``
    contains the hits of the pulses in the frame of the crystal.

    Parameters
    ----------
    out
        LH5 file to write; it appears when it is complete.
    detector
        icpc, bege, ppc, a YAML file, a siggen configuration or LEGEND metadata.
    events
        Without hits: N events of each peak, or FEP=10000,SEP=3000,1500-1580=500 (keV). With
        them: only events in FEP,SEP,1500-1580; else all.
    hits
        File of hits: remage LH5, g4simple or Geant4 CSV/HDF5, NPZ, or an earlier output.
    frame
        How a file of hits is read.
    settings
        Override a value of the detector or of the settings, bias_V=3500, or all those in a
        YAML file (repeatable).
    seed
        Seed of all random numbers.
    force
        Replace an existing file.

    Raises
    ------
    CpunetError
        If the file exists, the detector is not depleted, the hits cannot be used, or none
        gives a signal.

    Examples
    --------
    cpunet simulate --detector icpc --events FEP=10000,DEP=3000 --out sim.lh5

    cpunet simulate --detector V01.yaml --hits stp.lh5 --flip-z --out sim.lh5
    """
    require_seed(seed)
    out = Path(out)
    words = () if isinstance(settings, Mapping) else settings
    if hits is not None and not isinstance(hits, HitFile):
        hits = HitFile(Path(hits), frame)
    files = (detector, *words, hits.path if hits else None)
    refuse_inputs(out, *(file for file in files if isinstance(file, str | Path)))
    crystal, physics = detector_and_settings(detector, settings)
    peaks = load_recipe("fast").peaks
    source: HitFile | GammaSource
    if hits is not None:
        windows = energy_windows(peaks if events is None else events, peaks, physics.window_kev)
        source = hits if events is None else replace(hits, windows=tuple(windows))
    elif events is not None:
        wanted = wanted_events(events, peaks, physics.window_kev)
        windows = list(wanted)
        source = GammaSource(wanted, physics.source_height_mm, physics.source_radius_mm, seed)
    else:
        raise CpunetError("give `hits` of a file, or `events` for the gamma Monte Carlo")
    simulation = Simulation(out, crystal, physics, windows)
    attrs = {MADE_BY: f"cpunet simulate {cpunet.__version__}"}
    writer = PulseWriter(out, attrs=attrs, force=force)
    opened, simulator = source.open(crystal), Simulator(crystal, physics)
    with writer:
        for before_merging, block in simulator.blocks(opened, f"Simulating {crystal.name}"):
            simulation.count(before_merging, block)
            seen = block.collected_kev > 0
            columns: dict[str, tuple[Any, str]] = {"lost_energy": (block.lost_kev[seen], "keV")}
            columns["n_hits"] = np.diff(block.hits.offsets)[seen], ""
            if physics.electron_trapping_per_us or physics.hole_trapping_per_us:
                columns["trapped_energy"] = (block.trapped_kev[seen], "keV")
            writer.append(block.pulses(), columns)
            writer.append_rows(HIT_TABLE, hit_columns(block.hits[seen]))
        if not writer.n_pulses:
            raise CpunetError(
                f"{out}: none of {simulation.counts['events']} events gives a signal: their "
                f"hits lie outside {crystal.name} or in its contacts; check their frame"
            )
        provenance = {
            "cpunet": cpunet.__version__,
            "detector": crystal.model_dump(mode="json"),
            "settings": physics.model_dump(mode="json"),
            "hits": source.provenance(),
            "seed": seed,
            "events": simulation.counts["events"],
            "events_without_signal": simulation.counts["events_without_signal"],
            "depletion_V": simulator.fields.depletion_V,
        }
        writer.annotate(SIMULATION, json.dumps(provenance))
    return simulation


_PULSES = "geds/sim"


@dataclass(frozen=True, eq=False)
class StoredSimulation:
    """Physics and hits of the pulses in a file of ``cpunet simulate`` or of a test stand.

    Parameters
    ----------
    detector, settings
        Detector and settings of the simulation, with the period of the pulses in the file.
    hits
        Merged hits, one event per pulse, in the order of the pulses.
    """

    detector: Detector
    settings: SimulationSettings
    hits: Hits

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a file.

        Raises
        ------
        CpunetError
            If the file cannot be read, does not record how it was made, or holds hits of other
            events than pulses.
        """
        file = Path(path)
        with opened(file) as content:
            text = content[_PULSES].attrs.get("simulation") if _PULSES in content else None
            if text is None or HIT_TABLE not in content:
                wrong = f"{file}: no {_PULSES} with its simulation, or no {HIT_TABLE}"
                raise CpunetError(wrong, "give an output of cpunet simulate or of a test stand")
            numbers = np.asarray(content[f"{_PULSES}/event_number"][()])
        try:
            made = json.loads(text)
            detector = Detector.model_validate(made["detector"])
            settings = SimulationSettings.model_validate(made["settings"])
        except (KeyError, TypeError, ValueError) as error:
            raise CpunetError(
                f"{file}: what {_PULSES} tells of its simulation cannot be used by this "
                "version; simulate it again"
            ) from error
        hits = read_hits(file)
        if not np.array_equal(hits.event_number, numbers):
            raise CpunetError(
                f"{file}: {HIT_TABLE} holds other events than {_PULSES}, or in another order; "
                "simulate it again"
            )
        return cls(detector, settings, hits)
