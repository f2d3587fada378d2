"""Translate the templates of pulse-shape libraries."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.legend.library_arrays import Arrays, add_t0, charge_arrays, current_arrays
from cpunet.legend.library_file import (
    WAVEFORM,
    libraries,
    n_not_ending,
    n_templates,
    require_charge,
    sampling_period_ns,
)
from cpunet.legend.production import in_words, translate_for_production
from cpunet.legend.ring_padding import RINGS
from cpunet.legend.templates import BEFORE_NS, TemplateTranslator, linearity
from cpunet.outputs import refuse_existing, written_aside
from cpunet.progress import Stage, stage
from cpunet.pulses.container import FloatArray
from cpunet.pulses.preparation import Rejection
from cpunet.pulses.reading.source import BLOCK_BYTES
from cpunet.pulses.writing import FileInTheMaking
from cpunet.training.devices import resolve_device
from cpunet.training.run import RunLike, as_run
from cpunet.translation.translator import REN

TEMPLATES_AT_A_TIME = 1024
KEPT = 256  # templates to measure the linearity with


@dataclass
class _Tally:
    """Counts of the templates by outcome, and a sample of one length with its translator."""

    currents: bool
    counts: Counter[str] = field(default_factory=Counter)
    not_ending: int = 0
    kept: list[FloatArray] = field(default_factory=list)
    translate: TemplateTranslator | None = None

    def add(
        self,
        templates: npt.NDArray[np.floating],
        codes: npt.NDArray[np.uint8],
        translate: TemplateTranslator,
        seed: int,
    ) -> None:
        outside = np.isnan(templates).all(axis=1)
        unknown, accepted = codes == Rejection.NAN, codes == Rejection.ACCEPTED
        self.counts["templates"] += len(codes)
        self.counts["outside"] += int(outside.sum())
        self.counts["damaged"] += int((unknown & ~outside).sum())
        for code in codes[~(unknown | accepted)]:
            self.counts[Rejection(int(code)).label] += 1
        good = np.flatnonzero(accepted & templates.any(axis=1))
        self.counts["translated"] += int(accepted.sum())
        # the maximum of a current is that of positive charge; charge may have either sign
        rising = templates[good] if self.currents else np.abs(templates[good])
        self.not_ending += n_not_ending(rising)
        self.counts["moving"] += len(good)
        if len(good):
            few = np.random.default_rng(seed).permutation(good)[:8]
            self._keep(np.asarray(templates[few], np.float32), translate)

    def _keep(self, few: FloatArray, translate: TemplateTranslator) -> None:
        if self.translate is not None:
            before = self.translate.dt_ns, self.kept[-1].shape[1]
            if before != (translate.dt_ns, few.shape[1]):  # no sums of these with those
                self.kept = []
        self.kept.append(few)
        self.translate = translate


@dataclass(frozen=True)
class TranslatedLibrary:
    """A library that was translated.

    Parameters
    ----------
    path
        The file.
    numbers
        Of charge and currents ``libraries`` (their paths), ``templates``, ``translated``,
        ``outside`` (all NaN), ``rejections`` (counts by reason) and ``linearity`` (see
        `cpunet.legend.templates.Linearity`).  For production, by name of the library, see
        `cpunet.legend.production.translate_for_production`.
    """

    path: Path
    numbers: dict[str, Any]

    def __str__(self) -> str:
        if "libraries" not in self.numbers:
            return "\n".join(
                f"{self.path}: {name}: {in_words(one)}" for name, one in self.numbers.items()
            )
        told, apart = self.numbers, self.numbers["linearity"]
        rejected = "".join(f", {n} {reason}" for reason, n in told["rejections"].items())
        return (
            f"{self.path}: {told['translated']} of {told['templates']} templates translated; "
            f"{told['outside']} outside{rejected}\n"
            f"sums of {apart['events']} events: sample by sample within {apart['largest']:.1e} "
            f"of the highest, current amplitude within {apart['current_amplitude']:.1e} of "
            "itself"
        )


def translate_library(
    run: RunLike,
    library: str | Path,
    out: str | Path,
    *,
    format: Literal["charge", "currents", "simflow"] = "charge",
    detector: Sequence[str] = (),
    rings: int = RINGS,
    low_rank: int | None = None,
    force: bool = False,
) -> TranslatedLibrary:
    """Translate every template of a library without noise.

    A library is an LH5 ``struct{r, z, dt, t0, waveform_000_deg, ...}`` with templates of
    charge in arrays of shape (r, z, samples), as SolidStateDetectors.jl and
    `cpunet.make_library` make them; a file may hold several, at any depth.  Files are
    streamed.

    Parameters
    ----------
    run
        A trained run or its folder.
    library
        LH5 file of one library or more.
    out
        LH5 file to write.
    format
        charge: all else is copied unchanged; a missing ``t0``, without which reboost cannot
        read a library, becomes 0, templates with NaN stay.  currents: for
        `reboost.hpge.psd.maximum_current`, in 1/ns, averaged as for the current amplitude,
        with the maximum at time 0 (``t0`` is negative); ``drift_time_*_deg`` become the times
        of the maxima.  simflow: currents as LEGEND's production reads them.
    detector
        With simflow: library of the file to translate (repeatable); by default that of the
        detector that the run was trained with, or all if it is unknown.
    rings
        With simflow: rings of nodes beyond the crystal; 3 as production.
    low_rank
        With simflow: number of components in place of whole templates.
    force
        Replace an existing file.

    Returns
    -------
    TranslatedLibrary
        The file, with what was counted.

    Raises
    ------
    CpunetError
        If the file contains no library of charge templates, or the run cannot translate it.

    Examples
    --------
    cpunet library translate run psl.lh5 --out psl_ren.lh5
    cpunet library translate run psl.lh5 --out psl_simflow.lh5 --format simflow
    """
    if format != "simflow" and (low_rank is not None or detector or rings != RINGS):
        raise CpunetError(
            "`low_rank`, `rings` and `detector` are those of the `format` simflow; add it"
        )
    run, source, out = as_run(run), Path(library), Path(out)
    refuse_existing(out, run.folder, source, force=force)
    ren = REN.of(run, resolve_device("auto"))
    if format == "simflow":
        numbers = translate_for_production(
            run, ren, source, out, detectors=detector, rings=rings, rank=low_rank
        )
    else:
        numbers = _templates(ren, source, out, currents=format == "currents")
    return TranslatedLibrary(out, numbers)


def _templates(ren: REN, source: Path, out: Path, *, currents: bool) -> dict[str, Any]:
    tally = _Tally(currents)
    with opened(source) as given:
        paths = libraries(given, source)
        total = sum(n_templates(given, path, source) for path in paths)
    with opened(source) as given, written_aside(out) as aside:
        with FileInTheMaking(aside, out) as made, stage("Templates", total) as bar:
            _copy(given, made.h5, _Job(ren, tally, source, bar))
        counts = tally.counts
        require_charge(str(source), counts["templates"], counts["moving"], tally.not_ending)
        assert tally.translate is not None
        apart = linearity(tally.translate, np.concatenate(tally.kept)[-KEPT:])
    numbers = {"templates", "translated", "outside", "moving"}
    return {
        "libraries": paths,
        "templates": counts["templates"],
        "translated": counts["translated"],
        "outside": counts["outside"],
        "rejections": {k: n for k, n in counts.items() if k not in numbers and n},
        "linearity": asdict(apart),
    }


@dataclass(frozen=True)
class _Job:
    ren: REN
    tally: _Tally
    source: Path
    bar: Stage


def _copy(given: h5py.Group, made: h5py.Group, job: _Job) -> None:
    """Copy a group and everything in it, and translate the templates of libraries."""
    made.attrs.update(given.attrs)
    angles = {name.removeprefix("waveform_") for name in filter(WAVEFORM.fullmatch, given)}
    replaced = {f"waveform_{angle}" for angle in angles}
    currents = job.tally.currents
    if currents and angles:
        replaced |= {"t0"} | {f"drift_time_{angle}" for angle in angles}
    for name, item in given.items():
        if isinstance(item, h5py.Group):
            _copy(item, made.create_group(name), job)
        elif name not in replaced:
            given.copy(name, made)
    if not angles:
        return
    dt_ns = sampling_period_ns(given, f"{job.source}: {given.name.strip('/') or '/'}")
    translate = TemplateTranslator(job.ren, dt_ns)
    for angle in sorted(angles):
        item = given[f"waveform_{angle}"]
        arrays = (
            current_arrays(item, made, angle, dt_ns)
            if currents
            else charge_arrays(item, made, angle)
        )
        _translate(item, arrays, translate, job)
    if "t0" not in made:
        add_t0(given["dt"], made, dt_ns, BEFORE_NS if currents else 0.0)
        made.attrs["datatype"] = f"struct{{{','.join(made)}}}"


def _translate(
    given: h5py.Dataset, made: Arrays, translate: TemplateTranslator, job: _Job
) -> None:
    n_r, n_z, n_samples = given.shape
    step = max(TEMPLATES_AT_A_TIME // n_z, given.chunks[0] if given.chunks else 1)
    step = min(step, max(1, BLOCK_BYTES // (4 * n_z * n_samples)))
    for first in range(0, n_r, step):
        rows = slice(first, min(first + step, n_r))
        templates = given[rows].reshape(-1, n_samples)
        results, codes = translate(templates)
        # templates with NaN are outside the crystal and remain unchanged
        unknown = codes == Rejection.NAN
        results[unknown] = templates[unknown]
        made.put(rows, results, translate.dt_ns)
        job.tally.add(templates, codes, translate, seed=first)
        job.bar.update(len(templates))
