"""Read and prepare the input files of a command."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from cpunet.errors import CpunetError
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.cuts import CutWindows, apply_cuts, fit_cuts
from cpunet.pulses.peaks import EnergySelection, label_peaks
from cpunet.pulses.preparation import Kind, Prepared
from cpunet.pulses.provenance import recorded_detector
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.seen import Seen
from cpunet.pulses.sets import load_prepared
from cpunet.recipes.schema import Recipe

log = logging.getLogger(__name__)

Energies = npt.NDArray[np.float64]

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
    file, read_as, dt_ns
        File, its reading options, and its sampling period in ns.
    read, used, rejections
        Number of pulses read, of those used (text if unknown), and of others by reason.
    cuts
        Quality cuts of measured pulses.
    sha256
        Fingerprint of the pulses used.
    """

    file: str | None = None
    read_as: dict[str, Any] = {}
    dt_ns: float | None = None
    read: int | None = None
    used: int | str | None = None
    rejections: dict[str, int] = {}
    cuts: Annotated[CutWindows | None, Field(strict=False)] = None
    sha256: str | None = None

    def reading(self, file: PulseFile) -> PulseFile:
        """A file with the reading options that the training had for it as defaults."""
        told = self.read_as
        if self.file is None or Path(self.file).resolve() != file.path.resolve():
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
    of measured traces.
    """

    prepared: Prepared
    dt_ns: float
    path: Path
    energies_kev: Energies
    cuts: CutWindows | None = None
    read_as: dict[str, Any] = field(default_factory=dict)
    detector: str | None = None
    baselines: Baselines | None = None

    def provenance(self) -> SideInfo:
        """File, counts, and a fingerprint of the pulses used."""
        waveforms = np.ascontiguousarray(self.prepared.pulses.waveforms)
        return SideInfo(
            file=str(self.path),
            read_as=self.read_as,
            dt_ns=self.dt_ns,
            read=self.prepared.n_read,
            used=len(self.prepared),
            rejections=self.prepared.rejections,
            cuts=self.cuts,
            sha256=hashlib.sha256(waveforms.data).hexdigest(),
        )

    def fingerprint(self) -> dict[str, Any]:
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
    source = file.open()
    seen = Seen(source, side, recipe.preparation, insist=file.insist)
    try:
        prepared = load_prepared(
            source,
            recipe.preparation,
            side,
            select=selection.select,
            peaks=lambda energies: label_peaks(energies, recipe.peaks),
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
            "resample one of them",
        )


def _decays(prepared: Prepared, recipe: Recipe) -> bool:
    """Whether simulated pulses end below their maximum, as measured ones do."""
    end = prepared.pulses.waveforms[:, -recipe.preparation.tail_samples :].mean(axis=1)
    return bool(np.median(end) < MIN_SIMULATED_END)
