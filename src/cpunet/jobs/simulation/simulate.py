"""Simulate the pulses of hits in a detector, for the simulated side of a training."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.jobs.simulation.hit_sources import HitFile, HitSource, Window
from cpunet.jobs.simulation.simulation_summary import Clock, Summary
from cpunet.outputs import refuse_inputs
from cpunet.progress import stage
from cpunet.pulses.writing import PulseWriter
from cpunet.simulation.clustering import MERGING_MM, cluster_hits, merge_hits
from cpunet.simulation.events import EventPulses, simulate_events
from cpunet.simulation.fields import FieldMaps, compute_fields, scaled_to_depletion
from cpunet.simulation.gammas import with_resolution
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_readers.hit_table import TABLE as HIT_TABLE
from cpunet.simulation.hit_readers.hit_table import hit_columns
from cpunet.simulation.hits import FloatArray, Hits
from cpunet.simulation.library import build_library
from cpunet.simulation.settings import SimulationSettings

log = logging.getLogger(__name__)

Mode = Literal["exact", "library", "auto"]
ImpurityFrom = Literal["file", "depletion"]

# Building the library takes as long as drifting this many hits. For more hits it is faster,
# but its pulses deviate by up to `library_tolerance`.
LIBRARY_FROM_HITS = 200_000


@dataclass(frozen=True)
class Resolution:
    """FWHM of the reported energies: FWHM² = noise_kev2 + fano_kev E, in keV."""

    noise_kev2: float
    fano_kev: float

    def smear(self, energy_kev: FloatArray, seed: int) -> FloatArray:
        """Energies as they would be reported, see `with_resolution`."""
        return with_resolution(
            energy_kev, noise_kev2=self.noise_kev2, fano_kev=self.fano_kev, seed=seed
        )


def simulate_file(
    detector: Detector,
    source: HitSource,
    out: Path,
    settings: SimulationSettings,
    *,
    windows: tuple[Window, ...] = (),
    impurity_from: ImpurityFrom = "file",
    mode: Mode = "auto",
    cluster_mm: float = MERGING_MM,
    resolution: Resolution | None = None,
    seed: int = 0,
    force: bool = False,
) -> Summary:
    """Simulate the pulses of a detector and write them, with their hits, to an LH5 file.

    The table ``geds/sim`` is the input of `cpunet.train`: ``waveform``
    in units of the collected charge, collected ``energy`` (keV), ``event_number``,
    ``lost_energy`` (keV, deposited where it gives no signal), ``n_hits``, with trapping
    ``trapped_energy`` (keV, deposited elsewhere but not collected), and with a resolution
    ``true_energy``.  Its attribute ``simulation`` is the provenance in JSON.  ``geds/hits``
    contains the hits of the pulses in the frame of the crystal.

    Parameters
    ----------
    detector
        Geometry, impurities, bias and temperature.
    source
        Source of the hits.
    out
        LH5 file to write; it appears when it is complete.
    settings
        Settings of the drift and the pulses.
    windows
        Energy windows in which the summary counts pulses.
    impurity_from
        ``"depletion"`` scales the detector's impurities so that it depletes at its
        ``measured_depletion_V``.
    mode
        ``"exact"`` drifts every hit, ``"library"`` interpolates between pre-computed
        pulses; ``"auto"`` uses the library for `LIBRARY_FROM_HITS` hits or more.
    cluster_mm
        Distance in mm below which hits are merged; 0 merges none.
    resolution
        Resolution of the written energies; the pulses are unchanged.
    seed
        Seed of the resolution (the Monte Carlo has its own).
    force
        See `cpunet.train`.

    Raises
    ------
    CpunetError
        If the file exists, the detector is not depleted, the hits cannot be used, or none
        gives a signal.
    """
    clock = Clock()
    made_by = f"cpunet simulate {cpunet.__version__}"
    refuse_inputs(out, source.path if isinstance(source, HitFile) else None)
    writer = PulseWriter(out, attrs={"made_by": made_by}, force=force)
    _check(cluster_mm, resolution)
    opened = source.open(detector)
    clock.lap("reading")
    if opened.warning:
        log.warning(opened.warning)
    detector, fields = solved(detector, impurity_from)
    clock.lap("fields")
    summary = Summary()
    blocks = _merged(opened.blocks, detector, cluster_mm, summary)
    first = next(blocks)
    clock.lap("first hits")
    resolved = _resolved(mode, len(first.edep_kev) / len(first) * opened.n_events)
    summary.mode = resolved
    library = build_library(fields, settings) if resolved == "library" else None
    clock.lap("library")
    with writer, stage(f"Simulating {detector.name}", opened.n_events) as bar:
        for block in chain([first], blocks):
            clock.lap("waiting for hits")
            events = simulate_events(fields, block, settings, resolved, library)
            clock.lap("pulses")
            summary.add(detector, block, events, windows)
            _append(writer, block, events, settings, resolution, seed)
            clock.lap("writing")
            bar.update(len(block))
        if not writer.n_pulses:
            raise CpunetError(
                f"{out}: none of {summary.n_events} events gives a signal: their hits lie "
                f"outside {detector.name} or in its contacts; check the hits' frame"
            )
        summary.seconds = clock.seconds
        made = _made(detector, source, settings, cluster_mm, resolution, seed, summary)
        made["impurity_from"] = impurity_from
        made["depletion_V"] = fields.depletion_V
        writer.annotate({"simulation": json.dumps(made)})
    return summary


def _check(cluster_mm: float, resolution: Resolution | None) -> None:
    """Check the options before any work is done."""
    cluster_hits(Hits.of([], [], [0]), cluster_mm)
    if resolution is not None:
        resolution.smear(np.zeros(0), seed=0)


def solved(detector: Detector, impurity_from: ImpurityFrom) -> tuple[Detector, FieldMaps]:
    """The detector with the requested impurities, and its fields."""
    with stage(f"Fields of {detector.name}"):
        if impurity_from == "depletion":
            detector = scaled_to_depletion(detector)
        fields = compute_fields(detector)
    if impurity_from == "depletion":
        log.info(
            f"{detector.name}: impurities times {detector.impurity_scale:.4g}, so that it "
            f"depletes at the measured {detector.measured_depletion_V:g} V"
        )
    return detector, fields


def _resolved(mode: Mode, expected_hits: float) -> Literal["exact", "library"]:
    if mode != "auto":
        return mode
    return "library" if expected_hits >= LIBRARY_FROM_HITS else "exact"


def _merged(
    blocks: Iterator[Hits], detector: Detector, distance_mm: float, summary: Summary
) -> Iterator[Hits]:
    for block in blocks:
        summary.hits_before_merging += len(block.edep_kev)
        yield merge_hits(block, detector, distance_mm)


def _append(
    writer: PulseWriter,
    hits: Hits,
    events: EventPulses,
    settings: SimulationSettings,
    resolution: Resolution | None,
    seed: int,
) -> None:
    kept = events.collected_kev > 0
    pulses = events.pulses()
    columns: dict[str, tuple[Any, str]] = {
        "lost_energy": (events.lost_kev[kept], "keV"),
        "n_hits": (np.diff(hits.offsets)[kept], ""),
    }
    if any(settings.trapping_per_ns):
        columns["trapped_energy"] = (events.trapped_kev[kept], "keV")
    if resolution is not None:
        columns["true_energy"] = (pulses.energy_kev, "keV")
        # each block has its own seed, from the number of pulses before it in the file
        block_seed = int(np.random.SeedSequence((seed, writer.n_pulses)).generate_state(1)[0])
        pulses = replace(pulses, energy_kev=resolution.smear(pulses.energy_kev, block_seed))
    writer.append(pulses, columns)
    writer.append_rows(HIT_TABLE, hit_columns(hits[kept]))


def _made(
    detector: Detector,
    source: HitSource,
    settings: SimulationSettings,
    cluster_mm: float,
    resolution: Resolution | None,
    seed: int,
    summary: Summary,
) -> dict[str, Any]:
    """Provenance of the file, to be stored in it."""
    return {
        "cpunet": cpunet.__version__,
        "detector": detector.model_dump(mode="json"),
        "settings": settings.model_dump(mode="json"),
        "hits": source.provenance(),
        "mode": summary.mode,
        "cluster_mm": cluster_mm,
        "resolution": None if resolution is None else vars(resolution),
        "seed": seed,
        "events": summary.n_events,
        "events_without_signal": summary.without_signal,
    }
