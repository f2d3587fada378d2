"""Simulate the pulses of hits in a detector, for the simulated side of a training."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.outputs import refuse_inputs
from cpunet.pulses.provenance import MADE_BY, SIMULATION
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes import load_recipe
from cpunet.settings import Set, require_seed
from cpunet.simulation.gammas.sample import EnergyWindow
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_files import hit_columns, read_hits
from cpunet.simulation.hit_sources import (
    GammaSource,
    HitFile,
    energy_windows,
    wanted_events,
)
from cpunet.simulation.hit_tables import HIT_TABLE
from cpunet.simulation.hits import HitOptions, Hits
from cpunet.simulation.outline import LI_CONTACT, POINT_CONTACT
from cpunet.simulation.settings import SimulationSettings, detector_and_settings
from cpunet.simulation.simulator import EventPulses, Simulator


@dataclass(repr=False)
class Simulation:
    """A file of simulated pulses, with counts over all of its events.

    Hits are counted as merged, energies are in keV. ``lines`` counts, by window, the pulses
    whose collected energy is still in it; ``not_collected`` the hits whose charge was not all
    collected within the record.
    """

    path: Path
    detector: Detector
    settings: SimulationSettings
    windows: list[EnergyWindow]
    seed: int = 0
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

    @property
    def pulses(self) -> PulseFile:
        """The pulses, in their file."""
        return PulseFile(self.path)

    @property
    def without_signal(self) -> int:
        """Number of events that were not written because none of their hits gives a signal."""
        return self.n_events - self.n_written

    def count(self, before_merging: int, events: EventPulses) -> None:
        """Count a block of events, and its hits before they were merged."""
        hits = events.hits
        place = hits.r_mm, hits.z_mm
        inside = self.detector.inside(*place)
        contacts = np.isin(self.detector.region(*place), (POINT_CONTACT, LI_CONTACT))
        collected = events.collected_kev
        self.n_events += len(hits)
        self.hits_before_merging += before_merging
        self.n_written += int((collected > 0).sum())
        self.hits += len(hits.edep_kev)
        self.hits_outside += int((~inside).sum())
        self.hits_in_contacts += int((inside & contacts).sum())
        self.not_collected += int((events.valid & ~events.collected).sum())
        self.energy_kev += float(hits.energy_kev.sum())
        self.lost_kev += float(events.lost_kev.sum())
        self.trapped_kev += float(events.trapped_kev.sum())
        self.events_with_loss += int((events.lost_kev > 0).sum())
        for window in self.windows:
            within = (collected >= window.low_kev) & (collected <= window.high_kev)
            self.lines[window.name] += int(within.sum())

    def __repr__(self) -> str:
        return f"<Simulation {self.path}: {self.n_written} pulses of {self.detector.name}>"

    def __str__(self) -> str:
        lines = ", ".join(f"{n} {name}" for name, n in self.lines.items())
        text = [
            f"{self.n_written} of {self.n_events} events written ({lines} by collected "
            f"energy); {self.without_signal} without any signal",
            f"{self.hits} hits ({self.hits_before_merging} before merging): "
            f"{self.hits_in_contacts} in contacts and the lithium layer, "
            f"{self.hits_outside} outside the crystal",
            f"{self.lost_kev / self.energy_kev:.2%} of the energy lost there, in "
            f"{self.events_with_loss} events",
        ]
        if self.not_collected:
            text.append(f"{self.not_collected} hits not collected in full; raise length_ns")
        if self.trapped_kev:
            text.append(f"{self.trapped_kev / self.energy_kev:.2%} of the energy trapped")
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
    files = [f for f in (detector, *words) if isinstance(f, str | Path)]
    files += [hits.path if isinstance(hits, HitFile) else hits] if hits is not None else []
    refuse_inputs(out, *files)
    crystal, physics = detector_and_settings(detector, settings)
    peaks = load_recipe("fast").peaks
    windows = energy_windows(",".join(peaks), peaks, physics.window_kev)
    source: HitFile | GammaSource
    if hits is not None:
        source = hits if isinstance(hits, HitFile) else HitFile(Path(hits), frame)
        if events is not None:
            names = events if isinstance(events, str) else ",".join(events)
            windows = energy_windows(names, peaks, physics.window_kev)
            source = replace(source, windows=tuple(windows))
    elif events is not None:
        wanted = wanted_events(events, peaks, physics.window_kev)
        windows = list(wanted)
        source = GammaSource(wanted, physics.source_height_mm, physics.source_radius_mm, seed)
    else:
        raise CpunetError("give `hits` of a file, or `events` for the gamma Monte Carlo")
    simulation = Simulation(out, crystal, physics, windows, seed)
    attrs = {MADE_BY: f"cpunet simulate {cpunet.__version__}"}
    writer = PulseWriter(out, attrs=attrs, force=force)
    opened, simulator = source.open(crystal), Simulator(crystal, physics)
    with writer:
        for before_merging, block in simulator.blocks(opened, f"Simulating {crystal.name}"):
            simulation.count(before_merging, block)
            seen = block.collected_kev > 0
            columns: dict[str, tuple[Any, str]] = {
                "lost_energy": (block.lost_kev[seen], "keV"),
                "n_hits": (np.diff(block.hits.offsets)[seen], ""),
            }
            if any(physics.trapping_per_ns):
                columns["trapped_energy"] = (block.trapped_kev[seen], "keV")
            writer.append(block.pulses(), columns)
            writer.append_rows(HIT_TABLE, hit_columns(block.hits[seen]))
        if not writer.n_pulses:
            raise CpunetError(
                f"{out}: none of {simulation.n_events} events gives a signal: their hits lie "
                f"outside {crystal.name} or in its contacts; check their frame"
            )
        provenance = {
            "cpunet": cpunet.__version__,
            "detector": crystal.model_dump(mode="json"),
            "settings": physics.model_dump(mode="json"),
            "hits": source.provenance(),
            "seed": seed,
            "events": simulation.n_events,
            "events_without_signal": simulation.without_signal,
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
                raise CpunetError(
                    f"{file}: no {_PULSES} with its simulation, or no {HIT_TABLE}; give "
                    "an output of cpunet simulate or of a test stand"
                )
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
