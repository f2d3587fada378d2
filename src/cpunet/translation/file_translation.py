"""A run and options, applied to the pulses of a file row by row."""

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
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.outputs import refuse_existing
from cpunet.processes import give_back_large_arrays
from cpunet.progress import stage
from cpunet.pulses.preparation import rejections_of
from cpunet.pulses.provenance import TRANSLATED_BY, TRANSLATION, require_side
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.writing import PulseWriter, other_columns
from cpunet.tables import counted
from cpunet.training.run import RunLike, as_run, resolve_device
from cpunet.translation.forms import Form
from cpunet.translation.options import TranslateOptions
from cpunet.translation.translation import Counts, Translation
from cpunet.translation.translator import (
    IREN,
    NOISE_ROWS,
    REN,
    TranslatedPulses,
    Translator,
    noise_seed,
)

log = logging.getLogger(__name__)

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

    Raises
    ------
    CpunetError
        If the run cannot be used, or lacks information for output in ADC counts.
    """

    def __init__(
        self,
        run: RunLike,
        options: TranslateOptions,
        resume: bool = False,
        force: bool = False,
    ) -> None:
        self.run, self.options, self.resume, self.force = as_run(run), options, resume, force
        kind = IREN if options.inverse else REN
        self.translator: Translator = kind.of(self.run, resolve_device("auto", self.run.recipe))
        self.form = Form(self.run, self.translator, options)
        adc = options.adc is not None
        self.result = partial(Translation, self.run.name, self.run.recipe, adc=adc)

    def __call__(
        self, source: PulseFile, out: Path, noise_key: str | None = None
    ) -> Translation:
        """Translate a file, block by block, with its rows and other columns.

        Pulses that cannot be translated become rows of NaN (of 0 in ADC); the column
        ``rejection`` contains the reason (0: translated).

        Parameters
        ----------
        source
            Simulated pulses, or measured ones for the inverse.
        out
            LH5 file to write.
        noise_key
            Name that is combined with the seed, so that the noise of files or channels
            differs; None for the noise of `cpunet.translation.translator.Translator.translate`.

        Raises
        ------
        CpunetError
            If source or output cannot be used, no pulse can be translated, the source changes
            meanwhile, or another process writes the same output.
        """
        resume = self.resume and not self.force
        refuse_existing(out, self.run.folder, *source.files, force=self.force or resume)
        before = source_print(source)
        made_by = f"{self.run.weights_sha256}{self.run.recipe!r}"
        provenance = {
            "source": before,
            "run": hashlib.sha256(made_by.encode()).hexdigest(),
            "options": asdict(self.options) | {"noise_key": noise_key},
        }
        if resume and out.exists():
            return self.result(replace(finished(out, provenance), skipped=1), path=out)
        counts = Counts()
        give_back_large_arrays()
        with source.open() as pulses, self.writer(out, force=self.force) as writer:
            read_others, left_out = other_columns(pulses, OWN_COLUMNS)
            for column, reason in left_out.items():
                log.warning(f"{source.path.name}: column {column} is left out: {reason}")
            for block, counts_after in self._blocks(source, pulses, noise_key):
                others = read_others(counts.read, len(block.codes))
                columns = {"rejection": (block.codes, ""), **block.truth, **others}
                writer.append(block.pulses, columns)
                counts = counts_after
            if source_print(source) != before:
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
            samples=self.form.samples,
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
            for number, block in enumerate(pulses.blocks(NOISE_ROWS)):
                seed = noise_seed(self.options.seed, noise_key, number)
                done = self.form(block, np.random.default_rng(seed))
                numbers = len(block), int(done.valid.sum()), rejections_of(done.codes)
                counts += Counts(*numbers, done.saturated)
                yield done, counts
                bar.update(len(block))
        if not counts.translated:
            raise CpunetError(
                f"{pulses.path}: none of {counts.read} pulses can be translated "
                f"({counted(counts.rejections)}); are these {takes} pulses?"
            )


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
