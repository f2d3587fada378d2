"""A run and options, applied to the pulses of a file row by row."""

from __future__ import annotations

import hashlib
import json
import logging
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.outputs import refuse_existing, refuse_inputs
from cpunet.processes import give_back_large_arrays
from cpunet.progress import stage
from cpunet.pulses.container import Pulses
from cpunet.pulses.provenance import TRANSLATED_BY, TRANSLATION, require_side
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.writing import PulseWriter, other_columns
from cpunet.training.run import RunLike, as_run, resolve_device
from cpunet.translation.forms import Form
from cpunet.translation.options import TranslateOptions
from cpunet.translation.translator import (
    IREN,
    NOISE_ROWS,
    REN,
    TranslatedPulses,
    Translator,
    noise_seed,
)

log = logging.getLogger(__name__)

BLOCK_SIZE = 4096  # pulses read at a time; fewer if traces are long
BLOCK_SAMPLES = 1 << 24
OWN_COLUMNS = frozenset(
    {"waveform", "energy", "event_number", "rejection", "tails_kev"}
    | {"n_piled", "piled_kev", "piled_ns"}
)


@dataclass(frozen=True)
class Counts:
    """Numbers of rows: read, translated, rejected by reason, and saturated ones in ADC.

    Of several files also their number, and how many existed already; 1 or 0 for a single file.
    """

    read: int = 0
    translated: int = 0
    rejections: dict[str, int] = field(default_factory=dict)
    saturated: int = 0
    files: int | None = None
    skipped: int = 0

    @classmethod
    def of(cls, block: TranslatedPulses) -> Counts:
        """Count the rows of a block."""
        saturated = 0 if block.saturated is None else int(block.saturated.sum())
        return cls(len(block.codes), int(block.valid.sum()), block.rejections, saturated)

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.read + other.read,
            self.translated + other.translated,
            dict(Counter(self.rejections) + Counter(other.rejections)),
            self.saturated + other.saturated,
            skipped=self.skipped + other.skipped,
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
        self.kind: type[Translator] = IREN if options.inverse else REN
        self.translator = self.kind.of(self.run, resolve_device("auto", self.run.recipe))
        self.form = Form(self.run, self.translator, options)
        identity = f"{self.run.weights_sha256}{self.run.recipe!r}"
        self._print = hashlib.sha256(identity.encode()).hexdigest()

    def warn(self) -> None:
        """Say what the user should know of the output."""
        if self.form.fills_in:
            window = self.translator.recipe.preparation.length
            log.warning(
                f"a network knows windows of {window} samples alone; beyond them stand "
                "baseline and decay without noise"
            )

    def __call__(self, source: PulseFile, out: Path, noise_key: str | None = None) -> Counts:
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
        refuse_inputs(out, self.run.folder, *source.files)
        before = source_print(source)
        options = asdict(self.options) | {"noise_key": noise_key}
        provenance = {"source": before, "run": self._print, "options": options}
        if self.resume and not self.force and out.exists():
            return replace(finished(out, provenance), skipped=1)
        refuse_existing(out, force=self.force)
        counts = Counts()
        give_back_large_arrays()
        with self._opened(source) as pulses, self.writer(out, force=self.force) as writer:
            read_others, left_out = other_columns(pulses, OWN_COLUMNS)
            for column, reason in left_out.items():
                log.warning(f"{source.path.name}: column {column} is left out: {reason}")
            for block in self._blocks(pulses, noise_key):
                others = read_others(counts.read, len(block.codes))
                writer.append(block.pulses, {**block.columns, **others})
                counts += Counts.of(block)
            if source_print(source) != before:
                raise CpunetError(
                    f"{source.path}: changed while it was read; translate it once it is "
                    "complete"
                )
            record = provenance | {"counts": asdict(counts), "cpunet": cpunet.__version__}
            # options given from Python may be numbers of NumPy
            writer.annotate(TRANSLATION, json.dumps(record, default=np.generic.item), file=True)
        return counts

    def in_memory(self, source: PulseFile) -> TranslatedPulses:
        """Translated pulses of a file, the same as those of `__call__`.

        Raises
        ------
        CpunetError
            If the source cannot be used, or no pulse can be translated.
        """
        with self._opened(source) as pulses:
            return TranslatedPulses.joined(list(self._blocks(pulses, None)))

    def _opened(self, source: PulseFile) -> PulseSource:
        """Open a file of pulses that this run can translate."""
        pulses = source.open()
        self.translator.require_sampling(f"{source.path}:", pulses.dt_ns)
        remedy = f"{'leave out' if self.options.inverse else 'give'} `inverse`"
        if pulses.attrs.get(TRANSLATED_BY):
            remedy = f"translate the {self.kind.takes} ones that they were made of"
        require_side(pulses, self.kind.takes, remedy, insist=source.insist)
        return pulses

    def writer(self, out: Path, *, force: bool) -> PulseWriter:
        """Return a writer of translated pulses."""
        return PulseWriter(
            out,
            table=self.options.table or f"geds/{self.kind.part}",
            waveform_units="ADC" if self.options.adc else "",
            attrs={TRANSLATED_BY: f"cpunet {self.kind.part}", "run": self.run.name},
            samples=self.form.samples,
            force=force,
        )

    def _blocks(self, pulses: PulseSource, noise_key: str | None) -> Iterator[TranslatedPulses]:
        """Translate block by block; the noise depends only on the order of the pulses."""
        size = max(1, min(BLOCK_SIZE, BLOCK_SAMPLES // pulses.length))  # fits in memory
        counts = Counts()
        with stage("Translating", pulses.n_pulses) as bar:
            for number, block in enumerate(regrouped(pulses.blocks(size), NOISE_ROWS)):
                seed = noise_seed(self.options.seed, noise_key, number)
                generator = np.random.default_rng(seed)
                done = self.form(block, generator)
                counts += Counts.of(done)
                yield done
                bar.update(len(block))
        if not counts.translated:
            reasons = ", ".join(f"{n} {why}" for why, n in counts.rejections.items())
            raise CpunetError(
                f"{pulses.path}: none of {counts.read} pulses can be translated "
                f"({reasons}); are these {self.kind.takes} pulses?"
            )


def source_print(source: PulseFile) -> str:
    """Digest of names, sizes and times of the input files, and of how they are read.

    Raises
    ------
    CpunetError
        If a file does not exist.
    """
    if source.pulses is not None:
        content = source.pulses.waveforms, source.pulses.energy_kev
        return hashlib.sha256(b"".join(values.tobytes() for values in content)).hexdigest()
    paths = [source.path]
    elsewhere = (source.energy or "").rpartition(":")[0]
    if elsewhere and Path(elsewhere).is_file():
        paths.append(Path(elsewhere))
    facts: list[Any] = [source.table, source.energy, source.kev_per_adc, source.dt_ns]
    for path in paths:
        try:
            stat = path.stat()
        except OSError:
            raise CpunetError(f"{path}: no such file; check the name") from None
        facts.append((path.name, stat.st_size, stat.st_mtime_ns))
    return hashlib.sha256(repr(facts).encode(errors="surrogateescape")).hexdigest()


def regrouped(blocks: Iterable[Pulses], size: int) -> Iterator[Pulses]:
    """The same pulses in blocks of `size`, the last one shorter.

    Examples
    --------
    >>> pulses = Pulses.of(np.zeros((7, 2)), dt_ns=16)
    >>> [len(block) for block in regrouped([pulses[:2], pulses[2:3], pulses[3:]], 3)]
    [3, 3, 1]
    """
    waiting: list[Pulses] = []
    for block in blocks:
        waiting = [Pulses.concatenate([*waiting, block])]
        while len(waiting[0]) >= size:
            yield waiting[0][:size]
            waiting = [waiting[0][size:]]
    yield from (rest for rest in waiting if len(rest))


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
            names = ", ".join(n for n in value if record[what].get(n, ...) != value[n])
            other = f"other options ({names})"
        raise CpunetError(f"{out}: was made with {other}; choose another `out` or give `force`")
    return Counts(**record["counts"])
