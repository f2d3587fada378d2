"""Virtual test stands: simulated pulses, "measured" ones of other events, and their truth."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

import cpunet
from cpunet.electronics.chain import Electronics
from cpunet.electronics.exact_response import respond
from cpunet.electronics.readout import SATURATED, RawTraces, read_out
from cpunet.errors import CpunetError
from cpunet.jobs.simulation.growing_archive import GrowingArchive
from cpunet.jobs.simulation.stand_plan import (
    LABELS,
    OTHER,
    Kind,
    Labels,
    Side,
    StandPlan,
)
from cpunet.outputs import FolderKind, folder_written_aside
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.side import MADE_BY, SIDE
from cpunet.pulses.writing import PulseWriter
from cpunet.simulation.clustering import MERGING_MM
from cpunet.simulation.energy_windows import Window
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_readers.hit_table import TABLE as HIT_TABLE
from cpunet.simulation.hit_readers.hit_table import hit_columns
from cpunet.simulation.library_lookup import Library
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.shifted import Shift

MARKER = "stand.json"
STAND = FolderKind(
    name="stand",
    command="cpunet stand",
    known_by=MARKER,
    own=r"stand\.json|sim\.lh5|data\.lh5|truth\.npz|data_labels\.npz",
)
# Events per side from which building a library of pulses (20 s on two cores) takes less time
# than drifting their hits, about 20 each.
_LIBRARY_FROM_EVENTS = 20_000
# Truth about each measured trace besides its line, and its name in ``data_labels.npz``.
OF_DATA = {
    "flags": "flag",
    "remains_kev": "remains_kev",
    "n_piled": "n_piled",
    "piled_kev": "piled_kev",
    "piled_ns": "piled_ns",
}


@dataclass
class StandSummary:
    """Content of a stand: pulses by line for each side, and disturbed traces."""

    n_sim: int = 0
    n_data: int = 0
    sim_lines: Counter[str] = field(default_factory=Counter)
    data_lines: Counter[str] = field(default_factory=Counter)
    flags: Counter[str] = field(default_factory=Counter)


def make_stand(
    electronics: Electronics,
    detector: Detector,
    windows: tuple[Window, ...],
    events: tuple[int, ...],
    out: Path,
    *,
    kind: Kind = "matched",
    shift: Shift | None = None,
    settings: SimulationSettings | None = None,
    seed: int = 0,
    force: bool = False,
) -> StandSummary:
    """Make a stand of two independent sets of Tl-208 events.

    The folder contains ``sim.lh5`` (``geds/sim``: means of the ideal pulses over the
    digitiser's period; ``geds/hits``: their hits; the attribute ``simulation`` of the
    former: detector and settings, as in files of `cpunet.simulation.simulate`),
    ``data.lh5`` (``geds/raw``: raw traces of other events), ``truth.npz`` (``response``: the
    noise-free trace of each pulse of ``sim.lh5`` in units of the full charge, beginning after
    ``n_pre`` samples; ``label``: 0 DEP, 1 SEP, 2 FEP, 3 other, by collected energy, trapped
    included), ``data_labels.npz`` (``label``, ``flag``: 1 decaying
    baseline, 2 pile-up, 4 saturated; ``remains_kev``, ``n_piled``, ``piled_kev``,
    ``piled_ns``, see `cpunet.electronics.readout`) and ``stand.json``, its provenance.

    Parameters
    ----------
    electronics
        Readout chain of the data and of the truth.
    detector
        Simulated detector. In a ``"shifted"`` stand that of the data differs by `shift`; the
        truth is still the response of the chain to the simulated pulses.
    windows, events
        Windows of deposited energy, and the number of events in each, per side.
    out
        Output folder; it appears when it is complete.
    kind
        ``"matched"`` or ``"shifted"``.
    shift
        Deviations in a ``"shifted"`` stand; `Shift.default` if None.
    settings
        Settings of the simulated pulses, without the period; those of the data differ by the
        shift.
    seed
        Seed of all random numbers; the sides are independent.
    force
        See `cpunet.train`.

    Raises
    ------
    CpunetError
        If the folder exists, a window has no events, the chain cannot follow the pulses,
        or more than half of the traces saturate.
    """
    plan = StandPlan.of(
        electronics,
        detector,
        windows,
        events,
        kind=kind,
        shift=shift,
        settings=settings,
        seed=seed,
    )
    return write_stand(plan, out, force=force)


def write_stand(plan: StandPlan, out: Path, *, force: bool = False) -> StandSummary:
    """Make a planned stand, see `make_stand`."""
    many = sum(plan.sim.source.events) >= _LIBRARY_FROM_EVENTS
    summary = StandSummary()
    with folder_written_aside(out, STAND, force=force) as folder:
        library = plan.sim.library() if many else None
        _write_sim(folder, plan, library, summary)
        if many and plan.shift is not None:
            library = plan.data.library()
        _write_data(folder, plan, library, summary)
        made = {"cpunet": cpunet.__version__, **plan.provenance(), "counts": vars(summary)}
        (folder / MARKER).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    return summary


def _write_sim(
    folder: Path,
    plan: StandPlan,
    library: Library | None,
    summary: StandSummary,
) -> None:
    """Write ``sim.lh5`` and the truth of its pulses."""
    labels: list[Labels] = []
    electronics, side = plan.electronics, plan.sim
    per_sample = round(electronics.dt_ns / side.settings.dt_ns)
    writer = PulseWriter(folder / "sim.lh5", attrs=_made_by("simulated"))
    with GrowingArchive(folder / "truth.npz", "response", electronics.length) as truth:
        with writer:
            for fine, label, hits in side.blocks("Simulated events", library):
                writer.append(_block_means(fine, per_sample))
                writer.append_rows(HIT_TABLE, hit_columns(hits))
                truth.append(respond(fine, electronics))
                labels.append(label)
            writer.annotate({"simulation": json.dumps(_simulated(side, electronics.dt_ns))})
        label = np.concatenate(labels)
        truth.close(label=label, n_pre=np.array(electronics.n_pre))
    summary.n_sim = len(label)
    summary.sim_lines = _by_line(label)


def _write_data(
    folder: Path,
    plan: StandPlan,
    library: Library | None,
    summary: StandSummary,
) -> None:
    """Write ``data.lh5`` and the lines and flags of its traces."""
    electronics = plan.electronics
    labels: list[Labels] = []
    known: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in OF_DATA}
    writer = PulseWriter(
        folder / "data.lh5", table="geds/raw", waveform_units="ADC", attrs=_made_by("measured")
    )
    with writer:
        for fine, label, _ in plan.data.blocks("Measured events", library):
            block_seed = np.random.SeedSequence(
                (plan.readout_seed, writer.n_pulses)
            ).generate_state(1)
            traces = read_out(fine, electronics, int(block_seed[0]))
            writer.append(_as_pulses(traces))
            labels.append(label)
            for name, values in known.items():
                values.append(getattr(traces, name))
        label = np.concatenate(labels)
        told: dict[str, Any] = {
            OF_DATA[name]: np.concatenate(values) for name, values in known.items()
        }
        flag = told["flag"]
        saturated = int((flag & SATURATED > 0).sum())
        if 2 * saturated > len(flag):
            raise CpunetError(
                f"electronics {electronics.name}: {saturated} of {len(flag)} traces leave the "
                "ADC's range; lower gain_adc_per_kev or correct baseline_mean_adc and adc_bits"
            )
    np.savez(folder / "data_labels.npz", label=label, **told)
    summary.n_data = len(label)
    summary.data_lines = _by_line(label)
    for bit, name in ((1, "decaying baseline"), (2, "pile-up"), (SATURATED, "saturated")):
        summary.flags[name] = int((flag & bit > 0).sum())


def _simulated(side: Side, dt_ns: float) -> dict[str, Any]:
    """Provenance of the pulses of a side after averaging to the period `dt_ns`."""
    return {
        "cpunet": cpunet.__version__,
        "detector": side.detector.model_dump(mode="json"),
        "settings": side.settings.model_dump(mode="json") | {"dt_ns": dt_ns},
        "hits": side.source.provenance(),
        "cluster_mm": MERGING_MM,
    }


def _block_means(pulses: Pulses, per_sample: int) -> Pulses:
    """Pulses at a period `per_sample` times as long; each sample is the mean over it."""
    n, length = pulses.waveforms.shape
    whole = length // per_sample * per_sample
    blocks = pulses.waveforms[:, :whole].reshape(n, -1, per_sample)
    return Pulses.of(
        blocks.mean(axis=2),
        dt_ns=pulses.dt_ns * per_sample,
        energy_kev=pulses.energy_kev,
        event_number=pulses.event_number,
    )


def _as_pulses(traces: RawTraces) -> Pulses:
    # the writer stores samples unchanged: the integers of a digitiser stay integers
    return Pulses(
        waveforms=cast(FloatArray, traces.waveforms),
        dt_ns=traces.dt_ns,
        energy_kev=traces.energy_kev,
        event_number=traces.event_number,
        peak=np.full(len(traces), ""),
    )


def _by_line(labels: Labels) -> Counter[str]:
    names = {number: name for name, number in LABELS.items()} | {OTHER: "other"}
    return Counter({name: int((labels == i).sum()) for i, name in names.items()})


def _made_by(side: str) -> dict[str, str | float]:
    return {MADE_BY: f"cpunet stand {cpunet.__version__}", SIDE: side}
