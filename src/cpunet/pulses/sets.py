"""Prepare a file of raw pulses, block by block.

Only the windows of accepted pulses are kept, so memory grows with the pulses used and
not with the size of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.progress import stage
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Codes, FloatColumn, Kind, Prepared, Rejection, prepare
from cpunet.recipes.schema import PreparationConfig

# Traces per block: 20 to 130 MB for the record lengths in use.
BLOCK_SIZE = 4096
FEW = 10  # pulses of the wanted energies whose rejection is a reason

Select = Callable[[FloatColumn], npt.NDArray[np.bool_]]
PeakNames = Callable[[FloatColumn], npt.NDArray[np.str_]]

_REMEDIES = {
    Rejection.NAN: "where NaN pads pulses, continue their last value, or write them again",
    Rejection.CONSTANT: "check that these are the waveforms of a channel that was on",
    Rejection.SATURATED: "select lower energies or another channel",
    Rejection.WINDOW_OUTSIDE_RECORD: (
        "give longer records or allow more max_padding_before and max_padding_after"
    ),
    Rejection.NO_AMPLITUDE: "check the polarity and that the traces hold pulses",
    Rejection.TAIL_NOT_POSITIVE: "select higher energies",
    Rejection.ENERGY_UNKNOWN: (
        "name the column of their calibrated energies (`energy`, `data_energy`), or give "
        "`kev_per_adc`"
    ),
    Rejection.ENERGY_OUTSIDE_SELECTION: "check the calibration and the selected peaks",
}


class RawPulses(Protocol):
    """A source of raw pulses in blocks, such as a reader."""

    @property
    def path(self) -> Path:
        """Path of the file, for messages."""

    @property
    def n_pulses(self) -> int | None:
        """Number of pulses; None if it is unknown without reading the whole file."""

    def blocks(self, size: int, /) -> Iterator[Pulses]:
        """The file's pulses in order, at most `size` at a time."""


def load_prepared(
    source: RawPulses,
    config: PreparationConfig,
    kind: Kind,
    *,
    select: Select | None = None,
    peaks: PeakNames | None = None,
    max_pulses: int | None = None,
    seen: Callable[[Pulses, Prepared], None] | None = None,
) -> Prepared:
    """Read, select, prepare and collect the pulses of a file.

    Parameters
    ----------
    source
        Source of the raw pulses.
    config, kind
        See `prepare`.
    select
        Function that returns a mask of the wanted energies in keV.  Without it all pulses
        are wanted, even those of unknown energy.
    peaks
        Function that returns the name of the peak of each energy in keV.
    max_pulses
        Maximum number of accepted pulses to keep.  If there are more, a random sample of them
        is kept, always the same for the same file.  This bounds the memory.
    seen
        Function that is given each block of the file, and those of its pulses that can be used.

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
    n_read = n_kept = 0
    rng, drawn = np.random.default_rng(0), list[FloatColumn]()
    with stage(f"Preparing {source.path.name}", source.n_pulses) as bar:
        for block in source.blocks(BLOCK_SIZE):
            part = _prepare_selected(block, config, kind, select, peaks, n_read)
            if seen is not None:
                seen(block, part)
            n_read += len(block)
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


def _prepare_selected(
    block: Pulses,
    config: PreparationConfig,
    kind: Kind,
    select: Select | None,
    peaks: PeakNames | None,
    first_index: int,
) -> Prepared:
    """Prepare the selected pulses of a block; the others are coded as not selected."""
    codes: Codes = np.zeros(len(block), np.uint8)
    if select is not None:
        known = np.isfinite(block.energy_kev)
        codes[known] = np.where(
            select(block.energy_kev[known]),
            Rejection.ACCEPTED,
            Rejection.ENERGY_OUTSIDE_SELECTION,
        )
        codes[~known] = Rejection.ENERGY_UNKNOWN
    rows = np.flatnonzero(codes == Rejection.ACCEPTED)
    selected = block[rows]
    if peaks is not None:
        selected = replace(selected, peak=peaks(selected.energy_kev))
    part = prepare(selected, config, kind)
    codes[rows] = part.codes
    return replace(
        part, index=first_index + rows[part.index], codes=codes, first_index=first_index
    )


def _nothing_left(source: RawPulses, sets: list[Prepared]) -> CpunetError:
    codes = np.concatenate([s.codes for s in sets]) if sets else np.zeros(0, np.uint8)
    if not len(codes):
        return CpunetError(f"{source.path}: holds no pulses", "choose another file or table")
    counts = np.bincount(codes)
    reasons = ", ".join(
        f"{counts[c]} {Rejection(int(c)).label}" for c in np.flatnonzero(counts)
    )
    text = f"{source.path}: none of {len(codes)} pulses can be used ({reasons})"
    # of pulses of the wanted energies, if there are any, since these are what is missed
    wanted = np.bincount(codes[codes != Rejection.ENERGY_OUTSIDE_SELECTION], minlength=1)
    reason = int((wanted if wanted.sum() >= FEW else counts).argmax())
    return CpunetError(text, _REMEDIES[Rejection(reason)])
