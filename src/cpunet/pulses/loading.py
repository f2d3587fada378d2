"""Read and prepare the input files of a command, block by block.

Only the windows of accepted pulses stay, so memory grows with the pulses used and not with
the size of the file.
"""

from __future__ import annotations

import hashlib
import json
import logging
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cpunet.errors import CpunetError
from cpunet.progress import stage
from cpunet.pulses import provenance
from cpunet.pulses.baselines import TRACES, WHOLE, Baselines
from cpunet.pulses.container import FloatArray, Pulses, Rows
from cpunet.pulses.peaks import EnergySelection, label_peaks, suggested_calibration
from cpunet.pulses.preparation import (
    Codes,
    CutWindows,
    FloatColumn,
    Kind,
    Prepared,
    Rejection,
    apply_cuts,
    fit_cuts,
    prepare,
)
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource, amplitude
from cpunet.recipes.schema import MatchingConfig, PreparationConfig, Recipe

log = logging.getLogger(__name__)

# Traces per block: 20 to 130 MB for the record lengths in use.
BLOCK_SIZE = 4096
RATE_TRACES = 512  # first traces of a file, which are checked
# Why no pulse is left: least number of pulses of the wanted energies and least share of traces
# that roll over, and typical range of gamma energies.
FEW, FEW_ROLLED = 10, 0.02
MAX_KEV, MIN_KEV = 20_000.0, 20.0
MIN_SIMULATED_END = 0.98  # a pulse without electronics ends at 1, a measured one decays
# Windows are shorter by these if so many more of a file's first traces contain them.
SHORTER_NS, MORE, TRIED = range(320, 3201, 320), 0.01, 1024


_OR_PAD = "or allow more preparation.padding_before_ns and padding_after_ns"
# What to do where pulses are left out for a reason
REMEDIES = {
    Rejection.NAN: "where NaN pads pulses, continue their last value, or write them again",
    Rejection.CONSTANT: "check that these are the waveforms of a channel that was on",
    Rejection.SATURATED: "select lower energies or another channel",
    Rejection.WINDOW_OUTSIDE_RECORD: f"give longer records, {_OR_PAD}",
    Rejection.PULSE_AT_EDGE: f"give records with more before and after the pulse, {_OR_PAD}",
    Rejection.NO_PLATEAU: "give a longer preparation.after_ns: charge is collected later",
    Rejection.SECOND_PULSE: "check the rate: another pulse follows within the window",
    Rejection.NO_AMPLITUDE: "check the polarity and that the traces hold pulses",
    Rejection.TAIL_NOT_POSITIVE: "select higher energies",
    Rejection.TAIL_SLOPE: "tails differ: in-trace pile-up, or pile-up tails",
    Rejection.BASELINE: "baselines differ: pile-up tails (cpunet info --quality)",
    Rejection.BASELINE_SLOPE: "baselines are not flat: pile-up tails (cpunet info --quality)",
    Rejection.CHI2: "tails are no exponentials: pile-up",
    Rejection.COPIES: "these rows were written twice; write the file anew",
    Rejection.ENERGY_UNKNOWN: (
        "name the column of calibrated energies (`energy`, `data_energy`) or give `kev_per_adc`"
    ),
    Rejection.ENERGY_OUTSIDE_SELECTION: "check the calibration and the selected peaks",
}


class InfoPart(BaseModel):
    """Further entries stay as they are."""

    model_config = ConfigDict(
        extra="allow", frozen=True, strict=True, allow_inf_nan=False,
        arbitrary_types_allowed=True,
    )  # fmt: skip


class SideInfo(InfoPart):
    """The pulses of one side of a training, as far as a run says.

    Parameters
    ----------
    file, place, read_as, dt_ns
        File as given and its full path, its reading options, and its sampling period in ns.
    read, used, rejections
        Number of pulses read, of those used (text if unknown), and of others by reason.
    cuts
        Quality cuts of measured pulses.
    counts
        Lowest and highest count of measured traces.
    sha256
        Fingerprint of the pulses used.
    detector
        Name of the simulated detector, if the file contains it.
    """

    file: str | None = None
    place: str | None = None
    read_as: dict[str, Any] = {}
    dt_ns: float | None = None
    read: int | None = None
    used: int | str | None = None
    rejections: dict[str, int] = {}
    cuts: Annotated[CutWindows | None, Field(strict=False)] = None
    counts: Annotated[tuple[int, int] | None, Field(strict=False)] = None
    sha256: str | None = None
    detector: str | None = None

    def reading(self, file: PulseFile) -> PulseFile:
        """A file with the reading options that the training had for it as defaults."""
        own = self.read_as
        same = all(own.get(name) == value for name, value in file.options.items())
        return replace(file, **own) if same and self.place == str(file.path.resolve()) else file


@dataclass(frozen=True, eq=False)
class InputSet:
    """The prepared pulses of a file, with the quality cuts if they are measured.

    ``energies_kev`` contains the finite energies of all pulses of the file, selected or not;
    ``read_as`` the reading options, see `PulseFile.options`; ``detector`` the name of the
    simulated detector, if the file contains it; ``baselines`` what noise and pile-up tails need
    of measured traces; ``counts`` their lowest and highest sample; ``recipe`` that of its
    windows.
    """

    prepared: Prepared
    dt_ns: float
    path: Path
    energies_kev: FloatColumn
    recipe: Recipe
    cuts: CutWindows | None = None
    read_as: dict[str, Any] = field(default_factory=dict)
    detector: str | None = None
    baselines: Baselines | None = None
    counts: tuple[int, int] | None = None

    def provenance(self) -> SideInfo:
        """File, counts, and a fingerprint of the pulses used."""
        waveforms = np.ascontiguousarray(self.prepared.pulses.waveforms)
        of_file = ("read_as", "dt_ns", "cuts", "counts", "detector")
        return SideInfo(
            file=str(self.path),
            place=str(self.path.resolve()),
            read=self.prepared.n_read,
            used=len(self.prepared),
            rejections=self.prepared.rejections,
            sha256=hashlib.sha256(waveforms.data).hexdigest(),
            **{name: getattr(self, name) for name in of_file},
        )

    def fingerprint(self) -> dict[str, str | float]:
        """Entries of the provenance that identify the pulses used, wherever their file is."""
        return self.provenance().model_dump(include={"dt_ns", "used", "sha256"})


def load_pulses(
    file: PulseFile,
    side: Kind,
    recipe: Recipe,
    selection: EnergySelection,
    *,
    max_pulses: int | None = None,
    tell: bool = True,
    shorten: bool = False,
) -> InputSet:
    """Read and prepare the selected pulses of a file; measured ones have their quality cuts.

    Parameters
    ----------
    file, side
        File of pulses, and whether they are simulated or measured.
    recipe
        Recipe with the preparation, the cuts and the peaks.
    selection
        Energies to use.
    max_pulses
        Use a sample of so many pulses, if there are more.
    tell
        Whether the log has the counts.
    shorten
        Whether windows may be shorter than those of the recipe, if traces end before them.

    Raises
    ------
    CpunetError
        If the pulses are of the other side, none can be used, or their energies are not theirs.
    """
    with file.open() as source:
        remedy = "are `sim` and `data` swapped?"
        provenance.require_side(source, side, remedy, insist=file.insist)
        inputs, whole = _read(source, file, side, recipe, selection, max_pulses, shorten)
    recipe, prepared = inputs.recipe.at(inputs.dt_ns), inputs.prepared
    if inputs.baselines is not None:
        cuts = fit_cuts(prepared, recipe.cuts)
        prepared = apply_cuts(prepared, cuts)
        if not len(prepared):
            raise CpunetError(
                f"{file.path}: the quality cuts leave no pulse", "widen cuts.*_sigmas"
            )
        passed = [traces[np.isin(rows, prepared.index)] for rows, traces in whole]
        baselines = replace(inputs.baselines, whole=Pulses.concatenate(passed))
        inputs = replace(inputs, prepared=prepared, cuts=cuts, baselines=baselines)
    elif tell:
        ends = prepared.pulses.waveforms[:, -recipe.preparation.tail_samples :].mean(axis=1)
        if np.median(ends) < MIN_SIMULATED_END:
            question = "are they simulated ones, without electronics?"
            log.warning(f"{file.path.name}: these pulses decay; {question}")
    if tell:
        rejected = ", ".join(f"{n} {reason}" for reason, n in prepared.rejections.items())
        others = f" (left out: {rejected})" if rejected else ""
        used = f"{len(prepared)} of {prepared.n_read} pulses used"
        log.info(f"{file.path.name}: {used}{others}")
    return inputs


def _within_traces(block: Pulses, recipe: Recipe, name: str) -> Recipe:
    """The recipe with windows that end as early as the first traces of a file ask for.

    Slow pulses are late in their traces.  Without them, the distribution of drift times would
    be another one than that simulated.
    """
    windows, training = recipe.preparation, recipe.training
    if not isinstance(training, MatchingConfig):  # networks have windows of their own
        return recipe
    raw, dt_ns = block.waveforms, block.dt_ns
    needed = round((windows.after_ns - windows.padding_after_ns) / dt_ns)
    half = 0.5 * raw.min(axis=1, keepdims=True) + 0.5 * raw.max(axis=1, keepdims=True)
    if np.mean((raw >= half).argmax(axis=1) > raw.shape[1] - needed) <= MORE:
        return recipe

    tried, outside = list[Recipe](), list[float]()
    for by in (0, *SHORTER_NS):
        after, decay = windows.after_ns - by, windows.decay_fit_ns - by
        if by and min(after - training.level_ns, decay) <= 0:
            break
        to = {"after_ns": after, "decay_fit_ns": decay}
        within = training.model_copy(update={"after_ns": min(training.after_ns, after)})
        changed = {"preparation": windows.model_copy(update=to), "training": within}
        tried.append(recipe.model_copy(update=changed))
        codes = prepare(block, tried[-1].at(dt_ns).preparation, "measured").codes
        edge = np.isin(codes, (Rejection.PULSE_AT_EDGE, Rejection.WINDOW_OUTSIDE_RECORD))
        outside.append(edge.sum() / max((edge | (codes == Rejection.ACCEPTED)).sum(), 1))
    shares = np.array(outside)
    if shares[0] - shares.min() <= MORE:
        return recipe
    best = tried[int(np.argmax(shares <= shares.min() + 0.5 * MORE))]
    end = best.preparation.after_ns
    log.warning(
        f"{name}: {100 * shares[0]:.2g} % of the traces end before their windows "
        f"would; these end {end:g} ns after the alignment, not {windows.after_ns:g} ns"
    )
    return best


def _read(
    source: PulseSource,
    file: PulseFile,
    side: Kind,
    recipe: Recipe,
    selection: EnergySelection,
    max_pulses: int | None,
    shorten: bool,
) -> tuple[InputSet, list[tuple[Rows, Pulses]]]:
    """Read, select, prepare and collect the pulses of a file in one pass.

    Without quality cuts; also whole measured traces with their rows.

    If there are more than `max_pulses`, those with the smallest random numbers stay.  A pulse
    that is dropped early would also be dropped after all later ones were read, so they are a
    uniform sample of the whole file, always the same for the same file.
    """
    measured, before = side == "measured", set[int]()
    sets, drawn = list[Prepared](), list[FloatColumn]()
    seen = list[tuple[FloatColumn, FloatColumn]]()
    baselines, whole = list[Baselines](), list[tuple[Rows, Pulses]]()
    first, rng, start, n = np.empty((0, 0), np.float32), np.random.default_rng(0), 0, 0
    lowest, highest, counts = np.inf, -np.inf, None
    with stage(f"Preparing {source.path.name}", source.n_pulses) as bar:
        for block in source.blocks(BLOCK_SIZE):
            if not start:
                first = block.waveforms[:RATE_TRACES].copy()
                if shorten:
                    recipe = _within_traces(block[:TRIED], recipe, source.path.name)
                config = recipe.at(source.dt_ns).preparation
            # baselines are of pulses of any energy
            of_all = measured and sum(map(len, baselines)) < TRACES
            part, prepared = _selected(block, config, side, selection, before, of_all)
            if of_all:
                baselines.append(Baselines.of_block(block, prepared, config, *baselines[:1]))
            if measured:
                good = block.waveforms[np.isfinite(block.waveforms).all(axis=1)]
                lowest, highest = good.min(initial=lowest), good.max(initial=highest)
                rows = part.index[: max(WHOLE - sum(len(traces) for _, traces in whole), 0)]
                whole.append((start + rows, block[rows]))
            seen.append((block.energy_kev, amplitude(block.waveforms)))
            sets.append(part)
            drawn.append(rng.random(len(part)))
            start, n = start + len(block), n + len(part)
            if max_pulses is not None and n > 1.5 * max_pulses:
                n = _thin(sets, drawn, max_pulses)
            bar.update(len(block))
    energies, heights = map(np.concatenate, zip(*seen, strict=True))
    if max_pulses is not None and n > max_pulses:
        _thin(sets, drawn, max_pulses)
    if highest >= lowest and (first == first.round()).all():
        counts = int(lowest), int(highest)
    detector: str | None = None
    with suppress(ValueError, LookupError, TypeError):  # other programs may have such a name
        detector = str(json.loads(source.attrs[provenance.SIMULATION])["detector"]["name"])
    joined, finite = _joined(sets), energies[np.isfinite(energies)]
    inputs = InputSet(joined, source.dt_ns, source.path, energies_kev=finite, recipe=recipe)
    stored = Baselines.concatenate(baselines) if measured else None
    inputs = replace(
        inputs, read_as=file.options, detector=detector, baselines=stored, counts=counts
    )
    if not n:
        raise _nothing_left(inputs, selection, first, heights)
    if measured and not file.insist:
        provenance.require_sense(source.path, first, energies, heights)
    return inputs, whole


def _joined(sets: list[Prepared]) -> Prepared:
    """All sets as one; these lose their windows, so that pulses never exist twice in full."""
    n, filled = sum(map(len, sets)), 0
    # this memory is allocated as it is filled
    waveforms = np.empty((n, sets[0].pulses.length), np.float32)
    for number, part in enumerate(sets):
        waveforms[filled : filled + len(part)] = part.pulses.waveforms
        filled += len(part)
        empty = np.empty((len(part), 0), np.float32)
        sets[number] = replace(part, pulses=part.pulses.with_waveforms(empty))
    prepared = Prepared.concatenate(sets)
    return replace(prepared, pulses=prepared.pulses.with_waveforms(waveforms))


def _selected(
    block: Pulses,
    config: PreparationConfig,
    side: Kind,
    selection: EnergySelection,
    before: set[int],
    of_all: bool,
) -> tuple[Prepared, Prepared]:
    """The selected pulses of a block, and all that were prepared: `of_all`, or these.

    Pulses read `before`, as of rows written twice, are copies.  Simulated pulses without noise
    can be alike; their events must be the same, too.
    """
    codes: Codes = np.zeros(len(block), np.uint8)
    codes[~selection.select(block.energy_kev)] = Rejection.ENERGY_OUTSIDE_SELECTION
    codes[~np.isfinite(block.energy_kev)] = Rejection.ENERGY_UNKNOWN
    rows = np.arange(len(block)) if of_all else np.flatnonzero(codes == Rejection.ACCEPTED)
    prepared = prepare(block[rows], config, side)
    index, selected = rows[prepared.index], codes[rows[prepared.index]] == Rejection.ACCEPTED
    codes[rows] = np.where(codes[rows] == Rejection.ACCEPTED, prepared.codes, codes[rows])
    part = replace(prepared, index=index, codes=codes)[selected]
    copies: Codes = np.zeros(len(part), np.uint8)
    for number, row in enumerate(part.index):
        event = block.event_number[row] if side == "simulated" else 0
        key = hash((int(event), block.waveforms[row].tobytes()))
        copies[number] = Rejection.COPIES if key in before else Rejection.ACCEPTED
        before.add(key)
    part = part.rejected(copies)
    peak = label_peaks(part.pulses.energy_kev, selection.peaks)
    return replace(part, pulses=replace(part.pulses, peak=peak)), prepared


def _thin(sets: list[Prepared], drawn: list[FloatColumn], max_pulses: int) -> int:
    """Keep the `max_pulses` pulses with the smallest random numbers; return their number."""
    bound = np.partition(np.concatenate(drawn), max_pulses)[max_pulses]
    for number, part in enumerate(sets):
        stays = drawn[number] < bound
        codes = np.where(stays, Rejection.ACCEPTED, Rejection.NOT_DRAWN).astype(np.uint8)
        sets[number], drawn[number] = part.rejected(codes), drawn[number][stays]
    return max_pulses


def _nothing_left(
    inputs: InputSet, selection: EnergySelection, traces: FloatArray, amplitudes: FloatColumn
) -> CpunetError:
    """Why no pulse can be used, as traces or energies show it, or the most frequent reason."""
    path, codes, kev = inputs.path, inputs.prepared.codes, inputs.energies_kev
    measured, rolled = inputs.baselines is not None, provenance.rolled_over(traces)
    if rolled is not None and rolled.share >= FEW_ROLLED:
        return CpunetError(f"{path}: {rolled.text}", rolled.remedy)
    if np.mean(amplitude(-traces) > 2 * np.maximum(amplitude(traces), 0)) > 0.5:
        return CpunetError(
            f"{path}: the traces go down: their polarity is negative",
            "invert them, as by pulses.with_waveforms(-pulses.waveforms) in Python",
        )
    reasons = ", ".join(f"{n} {why}" for why, n in inputs.prepared.rejections.items())
    text = f"{path}: none of {len(codes)} pulses can be used ({reasons})"
    # of pulses of the wanted energies, if there are any, since these are what is missed
    wanted = np.bincount(codes[codes != Rejection.ENERGY_OUTSIDE_SELECTION], minlength=1)
    reason = int((wanted if wanted.sum() >= FEW else np.bincount(codes)).argmax())
    error = CpunetError(text, REMEDIES[Rejection(reason)])
    if not len(kev):
        calibration = suggested_calibration(amplitudes)
        like = f"{error}; their amplitudes look like {calibration}"
        return error if calibration is None else CpunetError(like)
    if selection.select(kev).any():
        return error
    low, middle, high = np.quantile(kev, (0.05, 0.5, 0.95))
    text = (
        f"{error}. Energies there: {low:.4g} to {high:.4g} keV, half of them above {middle:.4g}"
    )
    give = "give `kev_per_adc`" if measured else "multiply them in the file by"
    from_kev = max(np.floor(low / 100) * 100, provenance.LOW_KEV)
    if high > MAX_KEV and measured:
        text += f": if these are ADC counts, {give}"
    elif 0 < high < MIN_KEV:
        text += f": if these are MeV, {give} 1000"
    elif n := int((kev >= from_kev).sum()):
        text += f"; `peak` {from_kev:.0f}- takes {n} pulses"
    return CpunetError(text)


def require_both_sides(sim: InputSet, data: InputSet, selection: EnergySelection) -> list[str]:
    """Check that both sides have pulses of every selected energy.

    Returns
    -------
    list of str
        Remarks on the selection: gamma lines that are no longer available for the test.

    Raises
    ------
    CpunetError
        If a selected line or range has pulses on one side only.
    """
    energies = {side: side.prepared.pulses.energy_kev for side in (sim, data)}
    for part in selection.parts:
        counts = {side: int(part.select(kev).sum()) for side, kev in energies.items()}
        missing, other = sorted(counts, key=lambda side: counts[side])
        if not counts[other]:
            neither = f"neither has a pulse of {part.name} that can be used"
            raise CpunetError(f"{sim.path}, {data.path}: {neither}", "leave it out of `peak`")
        if not counts[missing]:
            others = f"{other.path.name} has {counts[other]}"
            text = f"{missing.path}: no pulse of {part.name} can be used, {others}"
            raise CpunetError(text, "leave it out of `peak`, or give a file that has them")
    lines = selection.lines_in_ranges
    if not lines:
        return []
    are = "is" if len(lines) == 1 else "are"
    return [f"{', '.join(lines)} {are} in the range trained on, and no test of it any more"]


def require_same_sampling(sim: InputSet, data: InputSet) -> None:
    """Raise a `CpunetError` if the two sides differ in their sampling period."""
    if not np.isclose(sim.dt_ns, data.dt_ns):
        raise CpunetError(
            f"{sim.path}: sampled every {sim.dt_ns:g} ns, but {data.path} every "
            f"{data.dt_ns:g} ns",
            "resample one of them, or give `dt_ns` if one says it wrongly",
        )
