"""Virtual test stands: simulated pulses, "measured" ones of other events, and their truth."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

import cpunet
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.readout import FLAGS, by_height, linear_response, read_out
from cpunet.errors import CpunetError
from cpunet.outputs import FolderKind, folder_written_aside, refuse_inputs
from cpunet.pulses.container import Pulses
from cpunet.pulses.provenance import MADE_BY, SIDE, SIMULATION
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes import load_recipe
from cpunet.settings import Set, checked, key_values, read_json, require_seed
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_files import HIT_TABLE, hit_columns
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import Shift, SimulationSettings, detector_and_settings
from cpunet.simulation.simulate import GammaSource, wanted_events
from cpunet.simulation.simulator import Simulator
from cpunet.tables import counted

Labels = npt.NDArray[np.int64]

MARKER = "stand.json"
_FILES = r"stand\.json|sim\.lh5|data\.lh5|truth\.npz|data_labels\.npz"
STAND = FolderKind("stand", "cpunet stand", own=_FILES)
MADE = {MADE_BY: f"cpunet stand {cpunet.__version__}"}
LABELS = {"DEP": 0, "SEP": 1, "FEP": 2, "other": 3}
OTHER = LABELS["other"]
# Longest period of the simulated pulses at the input of the chain.
_COARSEST_NS = 4.0


@dataclass(frozen=True)
class Stand:
    """A virtual test stand: two sides of independent events, and the truth.

    Parameters
    ----------
    folder
        Folder of its files.
    electronics
        Readout chain of the data and of the truth.
    counts
        ``n_sim``, ``n_data``: numbers of pulses of each side; ``sim_lines``, ``data_lines``:
        the same by line; ``flags``: numbers of disturbed traces by disturbance.
    """

    folder: Path
    electronics: Electronics = field(repr=False)
    counts: Mapping[str, Any]

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Open the folder of a stand.

        Raises
        ------
        CpunetError
            If it is none, or cannot be read.
        """
        path = Path(folder) / MARKER
        stored = read_json(path, "give the folder of a stand, or make one with cpunet stand")
        electronics = checked(Electronics, stored.get("electronics", {}), str(path))
        return cls(Path(folder), electronics, stored.get("counts", {}))

    @property
    def sim(self) -> PulseFile:
        """The simulated pulses."""
        return PulseFile(self.folder / "sim.lh5")

    @property
    def data(self) -> PulseFile:
        """The raw traces."""
        return PulseFile(self.folder / "data.lh5")

    @property
    def truth(self) -> Path:
        """The file of noise-free responses of the simulated pulses."""
        return self.folder / "truth.npz"

    def __str__(self) -> str:
        of = self.counts
        sim, data, flags = (counted(of[k]) for k in ("sim_lines", "data_lines", "flags"))
        return (
            f"{self.folder}: sim.lh5: {of['n_sim']} pulses ({sim}), with truth.npz\n"
            f"{self.folder}: data.lh5: {of['n_data']} traces ({data}); {flags or 'undisturbed'}"
        )


def make_stand(
    out: str | Path,
    *,
    electronics: str | Path | Electronics = "legend200",
    detector: str | Path | Detector = "icpc",
    events: str | Mapping[str, int] = "FEP=4000,SEP=1500,DEP=1500",
    shift: Sequence[str] | Mapping[str, Any] = (),
    settings: Set = (),
    seed: int = 0,
    force: bool = False,
) -> Stand:
    """Make a test stand: simulated pulses, raw traces of other events, and the truth.

    The folder contains ``sim.lh5`` (``geds/sim``: means of the ideal pulses over the
    digitiser's period; ``geds/hits``: their hits; the attribute ``simulation`` of the
    former: detector and settings, as in files of `cpunet.simulate`), ``data.lh5``
    (``geds/raw``: raw traces of other events), ``truth.npz`` (``response``: the noise-free
    trace of each pulse of ``sim.lh5`` in units of the full charge, beginning after ``n_pre``
    samples; ``label``: 0 DEP, 1 SEP, 2 FEP, 3 other, by collected energy, trapped included),
    ``data_labels.npz`` (``label``, ``flag``: 1 decaying baseline, 2 pile-up, 4 saturated;
    ``tails_kev``, ``n_piled``, ``piled_kev``, ``piled_ns``, see
    `cpunet.electronics.readout`) and ``stand.json``, its provenance.

    Parameters
    ----------
    out
        Folder to make; it appears when it is complete.
    electronics
        Readout of the data and of the truth: ornl, legend200, ringing, mjd, or a YAML file.
    detector
        icpc, bege, ppc, a YAML file, a siggen configuration or LEGEND metadata.
    events
        Events of each peak or range (keV), for sim and data each.
    shift
        By what the data's detector differs from the simulated one: default, temperature_K=1.5,
        or a YAML file of keys (repeatable). The truth is the response to the simulated pulses.
    settings
        Override a value of the detector, of the settings or of the readout: bias_V=3500,
        earlier_pulses.rate_kHz=3, or all those in a YAML file (repeatable). dt_ns=10 is the
        period of the data and of the simulated pulses; records last as long at any.
    seed
        Seed of all random numbers; the sides are independent.
    force
        Replace an existing stand.

    Raises
    ------
    CpunetError
        If the folder exists, a window has no events, the chain cannot follow the pulses,
        or more than half of the traces saturate.

    Examples
    --------
    cpunet stand --preset legend200 --out stand

    cpunet stand --preset ornl --set earlier_pulses.rate_kHz=3 --out busy

    cpunet stand --preset mjd --detector ppc --out mjd

    cpunet stand --preset legend200 --set dt_ns=10 --out stand10

    cpunet stand --preset ornl --shift default --shift bias_V=20 --out stand2
    """
    words = [w for given in (shift, settings) if not isinstance(given, Mapping) for w in given]
    given = (electronics, detector, *words)
    refuse_inputs(Path(out), *(f for f in given if isinstance(f, str | Path)))
    values = key_values(settings, files=True)
    readout = Electronics.model_fields.keys() - {"name"}  # a name is that of the detector
    of_chain = {k: values.pop(k) for k in [*values] if k.split(".")[0] in readout}
    seed, moved = require_seed(seed), Shift.of(shift)
    chain = read_electronics(electronics, of_chain)
    crystal, physics = detector_and_settings(detector, values, dt_ns=chain.dt_ns)
    wanted = wanted_events(events, load_recipe("fast").peaks, physics.window_kev)
    for window, number in wanted.items():
        if number < 1:
            raise CpunetError(f"`events` {window.name}={number}: give at least 1 event")
    if physics.step_ns > _COARSEST_NS:
        raise CpunetError(
            f"settings: step_ns: a stand needs steps of at most {_COARSEST_NS:g} ns; lower it"
        )
    # The chain follows pulses of the longest period that is a part of that of the digitiser, of
    # whole steps, at most 4 ns, and at most half of `dt_ns` unless a step is as long.
    steps = round(chain.dt_ns / physics.step_ns)
    parts = (n for n in range(2, steps) if steps % n == 0 and chain.dt_ns <= n * _COARSEST_NS)
    fine = {"dt_ns": chain.dt_ns / next(parts, steps)}
    physics = checked(SimulationSettings, physics.model_dump() | fine, "settings")
    seeds = np.random.SeedSequence(seed).generate_state(3, np.uint32).tolist()
    source = wanted, physics.source_height_mm, physics.source_radius_mm
    sim = Side(crystal, physics, GammaSource(*source, seeds[0]))
    other = moved.applied(crystal), moved.applied(physics)
    data = Side(*other, GammaSource(*source, seeds[1]))
    with folder_written_aside(Path(out), STAND, force=force) as folder:
        label = _write_sim(folder, sim, chain)
        columns = _write_data(folder, data, seeds[2], chain)
        lines = (np.bincount(of, minlength=len(LABELS)) for of in (label, columns["label"]))
        sim_lines, data_lines = (dict(zip(LABELS, of.tolist(), strict=True)) for of in lines)
        flags = {name: int((columns["flag"] & bit > 0).sum()) for name, bit in FLAGS.items()}
        counts: dict[str, Any] = {"n_sim": len(label), "n_data": len(columns["label"])}
        counts |= {"sim_lines": sim_lines, "data_lines": data_lines, "flags": flags}
        made = {
            "cpunet": cpunet.__version__,
            "shift": moved.model_dump(mode="json") if shift else None,
            "seed": seed,
            "electronics": chain.model_dump(mode="json"),
            "sim": sim.provenance(),
            "data": data.provenance(),
            "counts": counts,
        }
        (folder / MARKER).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    return Stand(Path(out), chain, counts)


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

    def blocks(self, title: str) -> Iterator[tuple[Pulses, Labels, Hits]]:
        """Finely sampled pulses, their lines and their hits, block by block.

        Energies are calibrated as in a measurement: a factor, determined from the lines in the
        first block, corrects the median loss by charge trapping.

        Raises
        ------
        CpunetError
            If no event gives a signal.
        """
        simulator, gain = Simulator(self.detector, self.settings), 0.0
        for _, events in simulator.blocks(self.source.open(self.detector), title):
            detected, pulses = events.collected_kev > 0, events.pulses()
            if not len(pulses):
                continue
            untrapped = pulses.energy_kev + events.trapped_kev[detected]
            labels = np.full(len(untrapped), OTHER)
            for window in self.source.events:
                # sums of deposits are rounded
                low, high = window.low_kev - 1e-6, window.high_kev + 1e-6
                inside = (untrapped >= low) & (untrapped <= high)
                labels[inside] = LABELS.get(window.name, OTHER)
            share, lines = untrapped / pulses.energy_kev, labels != OTHER
            gain = gain or float(np.median(share[lines] if lines.any() else share))
            calibrated = replace(pulses, energy_kev=gain * pulses.energy_kev)
            yield calibrated, labels, events.hits[detected]
        if not gain:
            name = self.detector.name
            raise CpunetError(f"no event gives a signal in {name}; give more `events`")


def _write_sim(folder: Path, side: Side, electronics: Electronics) -> Labels:
    """Write ``sim.lh5`` and the truth of its pulses; return their lines."""
    labels: list[Labels] = []
    per_sample = round(electronics.dt_ns / side.settings.dt_ns)
    # the truth grows in a file of its own: it may be larger than memory
    rows, attrs = folder / "truth.rows", MADE | {SIDE: "simulated"}
    with rows.open("wb") as truth, PulseWriter(folder / "sim.lh5", attrs=attrs) as writer:
        for fine, label, hits in side.blocks("Simulated events"):
            # each sample is the mean over the digitiser's period
            whole = fine.length // per_sample * per_sample
            parts = fine.waveforms[:, :whole].reshape(len(fine), -1, per_sample)
            dt_ns = fine.dt_ns * per_sample
            writer.append(replace(fine, waveforms=parts.mean(axis=2), dt_ns=dt_ns))
            writer.append_rows(HIT_TABLE, hit_columns(hits))
            true = linear_response(fine, electronics)
            true = by_height(true, electronics, fine.energy_kev[:, np.newaxis])
            truth.write(true.astype(np.float32).tobytes())
            labels.append(label)
        simulation = {"cpunet": cpunet.__version__, **side.provenance()}
        simulation["settings"] |= {"dt_ns": electronics.dt_ns}  # that of the means
        writer.annotate(SIMULATION, json.dumps(simulation))
    label, n_pre = np.concatenate(labels), np.array(electronics.n_pre)
    response = np.memmap(rows, np.float32, "r", shape=(len(label), electronics.length))
    np.savez(folder / "truth.npz", response=response, label=label, n_pre=n_pre)
    rows.unlink()
    return label


def _write_data(
    folder: Path, side: Side, seed: int, electronics: Electronics
) -> dict[str, npt.NDArray[Any]]:
    """Write ``data.lh5``, and the lines and flags of its traces, which it returns."""
    parts: list[dict[str, npt.NDArray[Any]]] = []
    path, attrs = folder / "data.lh5", MADE | {SIDE: "measured"}
    with PulseWriter(path, table="geds/raw", waveform_units="ADC", attrs=attrs) as writer:
        for fine, label, _ in side.blocks("Measured events"):
            block_seed = np.random.SeedSequence((seed, writer.n_pulses)).generate_state(1)
            traces = read_out(fine, electronics, int(block_seed[0]))
            writer.append(traces)
            parts.append({"label": label} | traces.disturbed)
    whole: dict[str, Any] = {n: np.concatenate([part[n] for part in parts]) for n in parts[0]}
    saturated = whole["flag"] & FLAGS["saturated"] > 0
    if 2 * saturated.sum() > len(saturated):
        text = f"{saturated.sum()} of {len(saturated)} traces leave the ADC's range"
        remedy = "lower gain_adc_per_kev or correct baseline_mean_adc and adc_bits"
        raise CpunetError(f"electronics {electronics.name}: {text}", remedy)
    np.savez(folder / "data_labels.npz", **whole)
    return whole
