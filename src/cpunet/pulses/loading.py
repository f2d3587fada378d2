"""Read and prepare the input files of a command, block by block.

Only the windows of accepted pulses are kept, so memory grows with the pulses used and not with
the size of the file.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cpunet.errors import CpunetError
from cpunet.progress import stage
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import EnergySelection, label_peaks
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
    rejections_of,
)
from cpunet.pulses.provenance import recorded_detector
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.seen import Seen
from cpunet.recipes.schema import PreparationConfig, Recipe

# Traces per block: 20 to 130 MB for the record lengths in use.
BLOCK_SIZE = 4096
FEW = 10  # pulses of the wanted energies whose rejection is a reason

_REMEDIES = {
    Rejection.NAN: "where NaN pads pulses, continue their last value, or write them again",
    Rejection.CONSTANT: "check that these are the waveforms of a channel that was on",
    Rejection.SATURATED: "select lower energies or another channel",
    Rejection.WINDOW_OUTSIDE_RECORD: (
        "give longer records, or allow more preparation.padding_before_ns and padding_after_ns"
    ),
    Rejection.PULSE_AT_EDGE: (
        "give records with more before and after the pulse, or allow more "
        "preparation.padding_before_ns and padding_after_ns"
    ),
    Rejection.NO_PLATEAU: (
        "give a longer preparation.after_ns: the charge is not collected in time"
    ),
    Rejection.SECOND_PULSE: "check the rate: another pulse follows in nearly all traces",
    Rejection.NO_AMPLITUDE: "check the polarity and that the traces hold pulses",
    Rejection.TAIL_NOT_POSITIVE: "select higher energies",
    Rejection.ENERGY_UNKNOWN: (
        "name the column of their calibrated energies (`energy`, `data_energy`), or give "
        "`kev_per_adc`"
    ),
    Rejection.ENERGY_OUTSIDE_SELECTION: "check the calibration and the selected peaks",
}


def load_prepared(
    source: PulseSource,
    config: PreparationConfig,
    kind: Kind,
    *,
    selection: EnergySelection | None = None,
    max_pulses: int | None = None,
    seen: Seen | None = None,
) -> Prepared:
    """Read, select, prepare and collect the pulses of a file.

    Parameters
    ----------
    source
        Source of the raw pulses.
    config, kind
        See `prepare`.
    selection
        The wanted energies.  Without it all pulses are wanted, even those of unknown energy.
    max_pulses
        Maximum number of accepted pulses to keep.  If there are more, a random sample of them
        is kept, always the same for the same file.  This bounds the memory.
    seen
        Keeps what is needed of the raw traces.

    Returns
    -------
    Prepared
        Accepted pulses of the file; every pulse read has a code.

    Raises
    ------
    CpunetError
        If no pulse is left; the message gives the file, the counts by reason and a remedy.
    """
    sets: list[Prepared] = []
    n_kept, seen_before = 0, set[int]()
    rng, drawn = np.random.default_rng(0), list[FloatColumn]()
    with stage(f"Preparing {source.path.name}", source.n_pulses) as bar:
        for block in source.blocks(BLOCK_SIZE):
            whole = None
            if seen is not None and seen.more_baselines:  # which those of all energies have
                whole = prepare(block, config, kind)
            part = _selected(block, config, kind, selection, whole)
            part = part.rejected(_copies(block[part.index], kind, seen_before))
            if seen is not None:
                seen.keep(block, whole, part)
            n_kept += len(part)
            sets.append(part)
            drawn.append(rng.random(len(part)))
            if max_pulses is not None and n_kept > 1.5 * max_pulses:
                n_kept = _thin(sets, drawn, max_pulses)
            bar.update(len(block))
    if not n_kept:
        raise _nothing_left(source, sets)
    if max_pulses is not None and n_kept > max_pulses:
        n_kept = _thin(sets, drawn, max_pulses)
    return _joined(sets, n_kept)


def _copies(pulses: Pulses, kind: Kind, before: set[int]) -> Codes:
    """Codes of pulses, in which those read before, as of rows written twice, are copies.

    Simulated pulses without noise can be alike; their events must be the same, too.
    """
    codes: Codes = np.zeros(len(pulses), np.uint8)
    numbers = pulses.event_number if kind == "simulated" else codes
    for row, (trace, number) in enumerate(zip(pulses.waveforms, numbers, strict=True)):
        key = hash((int(number), trace.tobytes()))
        codes[row] = Rejection.COPIES if key in before else Rejection.ACCEPTED
        before.add(key)
    return codes


def _thin(sets: list[Prepared], drawn: list[FloatColumn], max_pulses: int) -> int:
    """Keep the `max_pulses` pulses with the smallest random numbers; return their number.

    A pulse dropped now would also be dropped after all later pulses were read, so the result is
    a uniform random sample of the whole file.
    """
    bound = np.partition(np.concatenate(drawn), max_pulses)[max_pulses]
    for number, part in enumerate(sets):
        stays = drawn[number] < bound
        codes = np.where(stays, Rejection.ACCEPTED, Rejection.NOT_DRAWN).astype(np.uint8)
        sets[number], drawn[number] = part.rejected(codes), drawn[number][stays]
    return max_pulses


def _joined(sets: list[Prepared], n: int) -> Prepared:
    """Concatenate blocks; each block's waveforms are released once they are copied."""
    # this memory is allocated as it is filled, so the pulses never exist twice in full
    waveforms = np.empty((n, sets[0].pulses.length), np.float32)
    first = 0
    for number, part in enumerate(sets):
        waveforms[first : first + len(part)] = part.pulses.waveforms
        first += len(part)
        empty = np.empty((len(part), 0), np.float32)
        sets[number] = replace(part, pulses=part.pulses.with_waveforms(empty))
    joined = Prepared.concatenate(sets)
    return replace(joined, pulses=joined.pulses.with_waveforms(waveforms))


def _selected(
    block: Pulses,
    config: PreparationConfig,
    kind: Kind,
    selection: EnergySelection | None,
    whole: Prepared | None,
) -> Prepared:
    """The selected pulses of a block, those of `whole` if all of it is prepared already."""
    codes: Codes = np.zeros(len(block), np.uint8)
    if selection is not None:
        known = np.isfinite(block.energy_kev)
        codes[known] = np.where(
            selection.select(block.energy_kev[known]),
            Rejection.ACCEPTED,
            Rejection.ENERGY_OUTSIDE_SELECTION,
        )
        codes[~known] = Rejection.ENERGY_UNKNOWN
    rows = np.flatnonzero(codes == Rejection.ACCEPTED)
    if whole is None:
        part = prepare(block[rows], config, kind)
        codes[rows] = part.codes
        part = replace(part, index=rows[part.index], codes=codes)
    else:
        part = whole.rejected(codes[whole.index])
        part = replace(part, codes=np.where(codes == Rejection.ACCEPTED, part.codes, codes))
    if selection is None:
        return part
    peak = label_peaks(part.pulses.energy_kev, selection.peaks)
    return replace(part, pulses=replace(part.pulses, peak=peak))


def _nothing_left(source: PulseSource, sets: list[Prepared]) -> CpunetError:
    codes = np.concatenate([s.codes for s in sets]) if sets else np.zeros(0, np.uint8)
    if not len(codes):
        return CpunetError(f"{source.path}: holds no pulses", "choose another file or table")
    counts = np.bincount(codes)
    reasons = ", ".join(f"{n} {reason}" for reason, n in rejections_of(codes).items())
    text = f"{source.path}: none of {len(codes)} pulses can be used ({reasons})"
    # of pulses of the wanted energies, if there are any, since these are what is missed
    wanted = np.bincount(codes[codes != Rejection.ENERGY_OUTSIDE_SELECTION], minlength=1)
    reason = int((wanted if wanted.sum() >= FEW else counts).argmax())
    return CpunetError(text, _REMEDIES[Rejection(reason)])


log = logging.getLogger(__name__)

MIN_SIMULATED_END = 0.98  # a pulse without electronics ends at 1, a measured one decays


class InfoPart(BaseModel):
    """Further entries are kept as they are."""

    model_config = ConfigDict(
        extra="allow",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
    )


class SideInfo(InfoPart):
    """The pulses of one side of a training, as far as they are known.

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
        told = self.read_as
        if self.place != str(file.path.resolve()):
            return file
        if any(told.get(name) != value for name, value in file.options.items()):
            return file
        return replace(file, **told)


@dataclass(frozen=True, eq=False)
class InputSet:
    """The prepared pulses of a file, with the quality cuts if they are measured.

    ``energies_kev`` contains the known energies of all pulses of the file, selected or not;
    ``read_as`` the reading options, see `PulseFile.options`; ``detector`` the name of the
    simulated detector, if the file contains it; ``baselines`` what noise and pile-up tails need
    of measured traces; ``counts`` their lowest and highest sample.
    """

    prepared: Prepared
    dt_ns: float
    path: Path
    energies_kev: FloatColumn
    cuts: CutWindows | None = None
    read_as: dict[str, Any] = field(default_factory=dict)
    detector: str | None = None
    baselines: Baselines | None = None
    counts: tuple[int, int] | None = None

    def provenance(self) -> SideInfo:
        """File, counts, and a fingerprint of the pulses used."""
        waveforms = np.ascontiguousarray(self.prepared.pulses.waveforms)
        return SideInfo(
            file=str(self.path),
            place=str(self.path.resolve()),
            read_as=self.read_as,
            dt_ns=self.dt_ns,
            read=self.prepared.n_read,
            used=len(self.prepared),
            rejections=self.prepared.rejections,
            cuts=self.cuts,
            counts=self.counts,
            sha256=hashlib.sha256(waveforms.data).hexdigest(),
            detector=self.detector,
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
        Whether the log says what was found.

    Raises
    ------
    CpunetError
        If the pulses are of the other side, none can be used, or their energies are not theirs.
    """
    with file.open() as source:
        recipe = recipe.at(source.dt_ns)
        seen = Seen(source, side, recipe.preparation, insist=file.insist)
        try:
            prepared = load_prepared(
                source,
                recipe.preparation,
                side,
                selection=selection,
                max_pulses=max_pulses,
                seen=seen,
            )
        except CpunetError as error:
            explained = seen.explained(error, selection)
            if explained is error:
                raise
            raise explained from error
    cuts = None
    if side == "measured":
        seen.require_sense()
        cuts = fit_cuts(prepared, recipe.cuts)
        prepared = apply_cuts(prepared, cuts)
        if not len(prepared):
            raise CpunetError(
                f"{file.path}: the quality cuts leave no pulse", "widen cuts.*_sigmas"
            )
    elif tell and _decays(prepared, recipe):
        log.warning(
            f"{file.path.name}: these pulses decay; "
            "are they simulated ones, without electronics?"
        )
    rejected = ", ".join(f"{n} {reason}" for reason, n in prepared.rejections.items())
    if tell:
        log.info(
            f"{file.path.name}: {len(prepared)} of {prepared.n_read} pulses used"
            + (f" (left out: {rejected})" if rejected else "")
        )
    return InputSet(
        prepared, source.dt_ns, file.path, seen.energies_kev, cuts, file.options,
        recorded_detector(source), None if cuts is None else seen.baselines(prepared),
        seen.counts,
    )  # fmt: skip


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
    for part in selection.parts:
        counts = [
            int(part.select(side.prepared.pulses.energy_kev).sum()) for side in (sim, data)
        ]
        if max(counts) == 0:
            raise CpunetError(
                f"{sim.path}, {data.path}: neither has a pulse of {part.name} that can be used",
                "leave it out of `peak`",
            )
        if min(counts) == 0:
            missing, there = (sim, data) if counts[0] == 0 else (data, sim)
            raise CpunetError(
                f"{missing.path}: no pulse of {part.name} can be used, {there.path.name} has "
                f"{max(counts)}",
                "leave it out of `peak`, or give a file that has them",
            )
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


def _decays(prepared: Prepared, recipe: Recipe) -> bool:
    """Whether simulated pulses end below their maximum, as measured ones do."""
    end = prepared.pulses.waveforms[:, -recipe.preparation.tail_samples :].mean(axis=1)
    return bool(np.median(end) < MIN_SIMULATED_END)
