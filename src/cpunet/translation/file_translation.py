"""A run and options, applied to the pulses of a file row by row.

Translated pulses are normalised windows, or raw traces in ADC counts.  Raw traces are the
inverse of the preparation: ``raw = baseline + scale * prepared``, with a scale proportional to
the energy.  A readout chain produces records of any length with noise throughout.  Its noise is
added once and nothing is normalised afterwards, so it does not change the height of a pulse.  A
network produces windows of fixed length.  They are padded with the baseline before them and
with the decay fitted to their end after them, both without noise.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import cpunet
from cpunet.electronics.drawn_pile_up import Columns, DrawnTails, InTracePileUp
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.networks.response_layer import padding, record_length
from cpunet.outputs import refuse_existing
from cpunet.processes import give_back_large_arrays
from cpunet.progress import stage
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Rejection, rejections_of
from cpunet.pulses.provenance import TRANSLATED_BY, TRANSLATION, require_side
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.writing import PulseWriter, other_columns
from cpunet.tables import counted
from cpunet.training.run import Run, RunLike, as_run, resolve_device
from cpunet.translation.backends import ResponseBackend
from cpunet.translation.options import LEARNED, NONE, Adc, TranslateOptions
from cpunet.translation.translation import Counts, Translation
from cpunet.translation.translator import (
    BATCH,
    IREN,
    REN,
    TranslatedPulses,
    Translator,
    noise_seed,
)

log = logging.getLogger(__name__)

# a file, its output, and a name that is combined with the seed, so that the noise of files or
# channels differs; None for the noise of `Translator.translate`
Task = tuple[PulseFile, Path, str | None]

HIGHEST = int(np.iinfo(np.uint16).max)
RISE_NS = 320.0  # of the pulse whose height defines the gain
MIN_ADC = 20.0  # raw traces have a larger median scale
OWN_COLUMNS = frozenset(
    {"waveform", "energy", "event_number", "rejection", "tails_kev"}
    | {"n_piled", "piled_kev", "piled_ns"}
)


class FileTranslation:
    """A trained run and options, ready to translate files.

    Parameters
    ----------
    run
        A trained run, or its folder.
    options
        How to translate.
    resume
        Whether an output that was made from this source with this run and options stays.
    force
        Whether to replace an existing file.

    Attributes
    ----------
    tails
        Distribution of the pile-up tails, which raise the baseline at the start of a trace;
        None for none.
    n_pre, length
        Samples of a trace before the alignment of a pulse without noise, and all.
    scale
        ADC counts per prepared unit and keV, and baseline in ADC counts; None for windows.
    ends
        Lowest and highest count.
    samples
        Type of the stored samples.

    Raises
    ------
    CpunetError
        If the run cannot be used or lacks information, or `n_pre` is not within the trace.
    """

    def __init__(
        self, run: RunLike, options: TranslateOptions, resume: bool = False, force: bool = False
    ) -> None:
        self.run, self.options, self.force = as_run(run), options, force
        self.resume = resume and not force
        kind = IREN if options.inverse else REN
        self.translator: Translator = kind.of(self.run, resolve_device("auto", self.run.recipe))
        adc, tails, config = options.adc, self.translator.tails, self.run.recipe.preparation
        self.result = partial(Translation, self.run.name, self.run.recipe, adc=adc is not None)
        self.tails: DrawnTails | None = None
        if tails is None and (options.tails != NONE or options.pile_up_khz):
            name = "tails" if options.tails != NONE else "pile_up_khz"
            raise CpunetError(
                f"`{name}` {getattr(options, name)}: the run tells nothing of pile-up tails "
                "and of other pulses (a network, or trained without raw traces)",
                "train a readout chain on raw traces, or leave it out",
            )
        if tails is not None and options.tails != NONE:
            learned = options.tails == LEARNED
            rate_khz = tails.rate_khz if learned else float(options.tails)
            passed = tails.passed if learned and adc is None else None  # cuts choose windows
            if rate_khz > 0:
                self.tails = replace(tails, rate_khz=rate_khz, passed=passed)
        self.n_pre, self.length, self.samples = config.samples_before, config.length, "f4"
        self.scale: tuple[float, float] | None = None
        if adc is None:
            return

        self.scale = adc_scale(self.run, self.translator, adc)
        self.ends = low, high = adc_ends(self.run, adc)
        kinds = {kind: np.iinfo(kind) for kind in ("u2", "i2", "u4", "i4")}
        self.samples = next(k for k, of in kinds.items() if of.min <= low and high <= of.max)
        self.length = self.length if adc.length is None else adc.length
        self.n_pre = self.n_pre if adc.n_pre is None else adc.n_pre
        if not 0 <= self.n_pre < self.length:
            raise CpunetError(
                f"`n_pre` {self.n_pre} is not within a trace of {self.length} samples; "
                "give less, or a longer `length`"
            )
        if isinstance(self.translator.backend, ResponseBackend):
            return
        if options.pile_up_khz:
            raise CpunetError(
                "a network knows no shapes beyond its windows, so it gives no raw traces with "
                "piled-up pulses; leave out `pile_up_khz` or `adc`"
            )
        after = self.length - self.n_pre
        if self.n_pre > config.samples_before or after > config.samples_after:
            log.warning(
                f"a network knows windows of {config.length} samples alone; beyond them stand "
                "baseline and decay without noise"
            )

    def __call__(self, task: Task) -> Translation:
        """Translate a file, block by block, with its rows and other columns.

        Pulses that cannot be translated become rows of NaN (of 0 in ADC); the column
        ``rejection`` contains the reason (0: translated).

        Raises
        ------
        CpunetError
            If source or output cannot be used, no pulse can be translated, the source changes
            meanwhile, or another process writes the same output.
        """
        source, out, noise_key = task
        refuse_existing(out, self.run.folder, *source.files, force=self.force or self.resume)
        made_by = f"{self.run.weights_sha256}{self.run.recipe!r}"
        provenance: dict[str, Any] = {
            "source": source_print(source),
            "run": hashlib.sha256(made_by.encode()).hexdigest(),
            "options": asdict(self.options) | {"noise_key": noise_key},
        }
        if self.resume and out.exists():
            return self.result(replace(finished(out, provenance), skipped=1), path=out)
        counts = Counts()
        give_back_large_arrays()
        with source.open() as pulses, self.writer(out, force=self.force) as writer:
            read_others, left_out = other_columns(pulses, OWN_COLUMNS)
            for column, reason in left_out.items():
                log.warning(f"{source.path.name}: column {column} is left out: {reason}")
            for block, counts in self._blocks(source, pulses, noise_key):
                n = len(block.codes)
                others = read_others(counts.read - n, n)
                columns = {"rejection": (block.codes, ""), **block.truth, **others}
                writer.append(block.pulses, columns)
            if source_print(source) != provenance["source"]:
                raise CpunetError(
                    f"{source.path}: changed while it was read; translate it once it is "
                    "complete"
                )
            record = provenance | {"counts": asdict(counts), "cpunet": cpunet.__version__}
            # options given from Python may be numbers of NumPy
            writer.annotate(TRANSLATION, json.dumps(record, default=np.generic.item), file=True)
        return self.result(counts, path=out)

    def in_memory(self, source: PulseFile) -> Translation:
        """Translate a file, or pulses, to the same pulses as `__call__`, without writing them.

        Raises
        ------
        CpunetError
            If the source cannot be used, or no pulse can be translated.
        """
        with source.open() as pulses:
            parts, counts = zip(*self._blocks(source, pulses, None), strict=True)
        done = TranslatedPulses.joined(parts)
        return self.result(counts[-1], in_memory=done, writer=self.writer)

    def writer(self, out: Path, *, force: bool) -> PulseWriter:
        """Return a writer of translated pulses."""
        part = self.translator.part
        return PulseWriter(
            out,
            table=self.options.table or f"geds/{part}",
            waveform_units="ADC" if self.options.adc else "",
            attrs={TRANSLATED_BY: f"cpunet {part}", "run": self.run.name},
            samples=self.samples,
            force=force,
        )

    def _blocks(
        self, source: PulseFile, pulses: PulseSource, noise_key: str | None
    ) -> Iterator[tuple[TranslatedPulses, Counts]]:
        """Translate block by block, with the counts so far.

        The noise depends only on the order of the pulses.
        """
        takes = self.translator.takes
        self.translator.require_sampling(f"{source.path}:", pulses.dt_ns)
        remedy = f"{'leave out' if self.options.inverse else 'give'} `inverse`"
        if pulses.attrs.get(TRANSLATED_BY):
            remedy = f"translate the {takes} ones that they were made of"
        require_side(pulses, takes, remedy, insist=source.insist)
        counts = Counts()
        with stage("Translating", pulses.n_pulses) as bar:
            for number, block in enumerate(pulses.blocks(BATCH)):
                seed = noise_seed(self.options.seed, noise_key, number)
                done = self.translated(block, np.random.default_rng(seed))
                numbers = len(block), int(done.valid.sum()), rejections_of(done.codes)
                counts += Counts(*numbers, done.saturated)
                yield done, counts
                bar.update(len(block))
        if not counts.translated:
            raise CpunetError(
                f"{pulses.path}: none of {counts.read} pulses can be translated "
                f"({counted(counts.rejections)}); are these {takes} pulses?"
            )

    def translated(self, pulses: Pulses, generator: np.random.Generator) -> TranslatedPulses:
        """Windows of pulses, NaN for rejected ones, or traces in ADC counts, 0 for these."""
        ren, n, energies = self.translator, len(pulses), pulses.energy_kev
        left, piled, truth = None, None, Columns()
        if self.tails is not None:
            left = self.tails.draw_kev(n, generator)
            truth = {"tails_kev": (left, "keV")}
        trace, rate_khz = (self.n_pre, self.length), self.options.pile_up_khz
        if rate_khz and ren.tails is not None:
            law, record = (rate_khz, ren.tails.energies_kev, ren.dt_ns), trace
            if self.scale is None:
                first = padding(ren.dt_ns)[0] + self.n_pre
                record = first, record_length(self.length, ren.dt_ns)
            piled = InTracePileUp.draw(n, *law, *record, generator)
            truth |= piled.columns()
        how: dict[str, Any] = {"noise": self.options.noise, "generator": generator}
        if self.scale is None:
            done = ren.translate_pulses(pulses, tails_kev=left, piled=piled, **how)
            return replace(done, truth=truth)

        done = ren.translate_pulses(pulses, piled=piled, trace=trace, **how)
        unknown = ~(np.isfinite(energies) & (energies > 0))
        done.codes[unknown & done.valid] = Rejection.ENERGY_UNKNOWN
        levels = done.pulses.waveforms
        if left is not None and self.tails is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                heights = left * self.tails.height / energies
            levels += heights[:, np.newaxis] * self.tails.decay(self.length, lead_us=0.0)
        levels[~done.valid] = np.nan

        per_kev, baseline = self.scale
        counts = np.rint(levels * (per_kev * energies)[:, np.newaxis] + baseline)
        counts[~np.isfinite(counts).all(axis=1)] = 0
        clipped = counts.clip(*self.ends)
        saturated = int((clipped != counts).any(axis=1).sum())
        # single precision represents these integers exactly
        traces = done.pulses.with_waveforms(clipped.astype(np.float32))
        return TranslatedPulses(traces, done.codes, saturated, truth)


def adc_ends(run: Run, adc: Adc) -> tuple[int, int]:
    """Lowest and highest count of a digitiser: of `bits`, or of those that the data need.

    Data that leave out saturated pulses end at their highest count.
    """
    low, high = run.data.counts or (0, HIGHEST)
    signed = low < 0
    bits = adc.bits or max(high.bit_length(), (-low - 1).bit_length()) + signed
    first, last = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    if adc.bits is None and run.data.rejections.get(Rejection.SATURATED.label):
        last = high
    log.info(f"counts from {first} to {last}, beyond which they are clipped (`bits`)")
    return first, last


def adc_scale(run: Run, translator: Translator, adc: Adc) -> tuple[float, float]:
    """ADC counts per prepared unit and keV, and baseline: as given, or those of the data.

    Parameters
    ----------
    run, translator
        The run, and its translator.
    adc
        Height of a fast pulse above the baseline per keV, and baseline, if they are given.

    Raises
    ------
    CpunetError
        If one of the two is neither given nor in the run.
    """
    per_kev, baseline, cuts = None, adc.baseline, run.data.cuts
    if cuts is not None and cuts.amplitude >= MIN_ADC:
        peak = run.recipe.peaks.get(run.peak)
        per_kev = None if peak is None else cuts.amplitude / peak.energy_kev
        if baseline is None:
            baseline = {window.name: window.centre for window in cuts.windows}.get("baseline")
    if adc.adc_per_kev is not None:  # of the maximum, in prepared units, of a fast pulse
        config = translator.recipe.preparation
        time = np.arange(config.length) - config.samples_before
        ramp = np.clip(time * translator.dt_ns / RISE_NS + 1, 0, 1).astype(np.float32)
        pulse = translator.apply(ramp[np.newaxis], energy_kev=np.ones(1), noise=False)
        height = float(pulse.max())
        if not (np.isfinite(height) and height > 0):
            raise CpunetError("the run cannot translate a fast pulse; train again")
        per_kev = adc.adc_per_kev / height
    if per_kev is None:
        raise CpunetError(
            f"{run.name}: does not say how many ADC counts a keV is; give `adc_per_kev`"
        )
    if baseline is None:
        raise CpunetError(f"{run.name}: does not say where the baseline is; give `baseline`")
    return per_kev, baseline


def source_print(source: PulseFile) -> str:
    """Digest of names, sizes and times of the input files, and of how they are read."""
    if source.pulses is not None:
        content = source.pulses.waveforms, source.pulses.energy_kev
        return hashlib.sha256(b"".join(values.tobytes() for values in content)).hexdigest()
    facts: list[Any] = [source.table, source.energy, source.kev_per_adc, source.dt_ns]
    for path in (source.path, Path((source.energy or "").rpartition(":")[0])):
        if path.is_file():
            stat = path.stat()
            facts.append((path.name, stat.st_size, stat.st_mtime_ns))
    return hashlib.sha256(repr(facts).encode(errors="surrogateescape")).hexdigest()


def finished(out: Path, wanted: dict[str, Any]) -> Counts:
    """Counts of an existing output that was made as requested.

    Parameters
    ----------
    out
        A translated file.
    wanted
        ``source``, ``run`` and ``options``.

    Raises
    ------
    CpunetError
        If it is no finished translation, or was made from another source, with another run or
        with other options.
    """
    try:
        with opened(out) as file:
            record = json.loads(file.attrs[TRANSLATION])
    except (CpunetError, LookupError) as error:
        raise CpunetError(
            f"{out}: is no translation that is finished; choose another `out` or give `force`"
        ) from error
    for what, value in wanted.items():
        if record[what] == value:
            continue
        other = f"another {what}"
        if what == "options":
            names = (name for name in value if record[what].get(name, ...) != value[name])
            other = f"other options ({', '.join(names)})"
        raise CpunetError(f"{out}: was made with {other}; choose another `out` or give `force`")
    return Counts(**record["counts"])
