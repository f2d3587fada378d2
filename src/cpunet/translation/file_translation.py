"""A run and options, applied to the pulses of a file row by row."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.memory import give_back_large_arrays
from cpunet.outputs import refuse_existing, refuse_inputs
from cpunet.progress import Stage, stage
from cpunet.pulses.container import Pulses
from cpunet.pulses.provenance import TRANSLATED_BY, TRANSLATION, recorded_side, require_side
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.row_columns import RowColumns
from cpunet.pulses.writing import PulseWriter
from cpunet.training.run import RunLike, as_run, resolve_device
from cpunet.translation.forms import (
    AdcTraces,
    Formed,
    OutputForm,
    Windows,
    adc_scale,
    wanted_pile_up,
    wanted_tails,
)
from cpunet.translation.noise_blocks import (
    NOISE_ROWS,
    Counts,
    interleaved,
    joined,
    noise_seed,
    regrouped,
)
from cpunet.translation.options import TranslateOptions
from cpunet.translation.translator import IREN, REN, Translator

log = logging.getLogger(__name__)

BLOCK_SIZE = 4096  # pulses read at a time; fewer if traces are long
BLOCK_SAMPLES = 1 << 24
OWN_COLUMNS = frozenset(
    {"waveform", "energy", "event_number", "rejection", "realisation", "tails_kev"}
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
    device
        ``"cpu"``, ``"cuda"`` or ``"auto"``.

    Raises
    ------
    CpunetError
        If the run cannot be used, or lacks information for output in ADC counts.
    """

    def __init__(self, run: RunLike, options: TranslateOptions, device: str = "auto") -> None:
        self.run, self.options = as_run(run), options
        self.kind: type[Translator] = IREN if options.inverse else REN
        self.translator = self.kind.of(self.run, resolve_device(device))
        self.form = self._form()
        identity = f"{self.run.weights_sha256}{self.run.recipe!r}"
        self._print = hashlib.sha256(identity.encode()).hexdigest()

    def warn(self) -> None:
        """Say what the user should know of the output."""
        if isinstance(self.form, AdcTraces) and self.form.fills_in:
            log.warning(
                f"a network knows windows of {self.form.config.length} samples alone; beyond "
                "them stand baseline and decay without noise"
            )

    def __call__(
        self,
        source: PulseFile,
        out: Path,
        *,
        noise_key: str | None = None,
        resume: bool = False,
        force: bool = False,
    ) -> dict[str, Any]:
        """Translate a file, block by block, keeping its rows and other columns.

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
        resume
            Whether to keep an output that was made from this source with this run and options.
        force
            Whether to replace an existing file.

        Returns
        -------
        dict
            ``read``, ``translated`` and ``rejections`` (counts of rows by reason); in ADC also
            ``saturated``, and ``skipped`` for an output that was kept.

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
        if resume and not force and out.exists():
            return finished(out, provenance) | {"skipped": True}
        refuse_existing(out, force=force)
        pulses = self.opened(source)
        others = _other_columns(pulses)
        with self.writer(out, force=force) as writer:
            counts = self._written(pulses, noise_key, writer, others)
            summary = self._summary(source, counts)
            if source_print(source) != before:
                raise CpunetError(
                    f"{source.path}: changed while it was read; translate it once it is "
                    "complete"
                )
            record = provenance | {"counts": summary, "cpunet": cpunet.__version__}
            # options given from Python may be numbers of NumPy
            writer.stamp(TRANSLATION, json.dumps(record, default=np.generic.item))
        return summary

    def in_memory(self, source: PulseFile) -> tuple[Formed, dict[str, Any]]:
        """Translated pulses of a file, and their counts, as those of `__call__`.

        Raises
        ------
        CpunetError
            If the source cannot be used, or no pulse can be translated.
        """
        counts, blocks = Counts(), list(self._blocks(self.opened(source), None))
        for block in blocks:
            counts.add(block)
        return joined(blocks), self._summary(source, counts)

    def opened(self, source: PulseFile) -> PulseSource:
        """Open a file of pulses that this run can translate.

        Raises
        ------
        CpunetError
            If it cannot be read, has another sampling period or is of the other side.
        """
        pulses = source.open()
        if not np.isclose(pulses.dt_ns, self.translator.dt_ns):
            raise CpunetError(
                f"{source.path}: sampled every {pulses.dt_ns:g} ns, the run was trained on "
                f"{self.translator.dt_ns:g} ns; resample the pulses"
            )
        require_side(pulses, self.kind.takes, self._remedy(pulses), insist=source.insist)
        return pulses

    def writer(self, out: Path, *, force: bool) -> PulseWriter:
        """Return a writer of translated pulses."""
        return PulseWriter(
            out,
            table=self.options.table or f"geds/{self.kind.part}",
            waveform_units=self.form.units,
            t0_ns=self.form.t0_ns,
            attrs={TRANSLATED_BY: f"cpunet {self.kind.part}", "run": self.run.name},
            samples=self.form.samples,
            force=force,
        )

    def _form(self) -> OutputForm:
        adc = self.options.adc
        tails = wanted_tails(self.translator, self.options.tails, raw=adc is not None)
        pile_up = wanted_pile_up(self.translator, self.options.pile_up_khz)
        if adc is None or not isinstance(self.translator, REN):
            return Windows(self.translator, tails, pile_up)
        scale = adc_scale(self.run, self.translator, adc)
        return AdcTraces(self.translator, *scale, adc, tails, pile_up)

    def _remedy(self, pulses: PulseSource) -> str:
        """Advice for pulses of the other side."""
        found = recorded_side(pulses)
        if found is not None and "translated" in found.why:
            return f"translate the {self.kind.takes} ones that they were made of"
        return f"{'leave out' if self.options.inverse else 'give'} `inverse`"

    def _summary(self, source: PulseFile, counts: Counts) -> dict[str, Any]:
        """Counts of rows, of which some must be translated."""
        summary = counts.summary(adc=self.options.adc is not None)
        if not summary["translated"]:
            reasons = ", ".join(f"{n} {why}" for why, n in summary["rejections"].items())
            raise CpunetError(
                f"{source.path}: none of {summary['read']} pulses can be translated "
                f"({reasons}); are these {self.translator.takes} pulses?"
            )
        return summary

    def _written(
        self,
        pulses: PulseSource,
        noise_key: str | None,
        writer: PulseWriter,
        others: RowColumns,
    ) -> Counts:
        give_back_large_arrays()
        counts, start, times = Counts(), 0, self.options.realisations
        for formed in self._blocks(pulses, noise_key):
            given = len(formed.codes) // times
            writer.append(formed.pulses, formed.columns, others.read(start, given, times))
            counts.add(formed)
            start += given
        if pulses.n_pulses not in (None, start):
            raise CpunetError(
                f"{pulses.path}: {start} pulses read of {pulses.n_pulses}; it changed while "
                "it was read, so translate it once it is complete"
            )
        return counts

    def _blocks(self, pulses: PulseSource, noise_key: str | None) -> Iterator[Formed]:
        """Translate block by block; the noise depends only on the order of the pulses."""
        with stage("Translating", pulses.n_pulses) as bar:
            for number, block in enumerate(regrouped(_read(pulses, bar), NOISE_ROWS)):
                seeds = (
                    noise_seed(self.options.seed, noise_key, number, realisation)
                    for realisation in range(self.options.realisations)
                )
                generators = map(self.translator.seeded, seeds)
                noise = self.options.noise
                yield interleaved(
                    [self.form(block, noise=noise, generator=one) for one in generators]
                )


def _read(pulses: PulseSource, bar: Stage) -> Iterator[Pulses]:
    """Blocks of a file that fit in memory, whatever the length of its traces."""
    for block in pulses.blocks(max(1, min(BLOCK_SIZE, BLOCK_SAMPLES // pulses.length))):
        yield block
        bar.update(len(block))


def _other_columns(pulses: PulseSource) -> RowColumns:
    """Find the columns to be copied to the output, and report those left out."""
    if pulses.layout.format in ("LH5", "HDF5"):
        n_pulses, table = pulses.n_pulses or 0, pulses.layout.table
        others = RowColumns.of_hdf5(pulses.path, table, n_pulses, OWN_COLUMNS)
    else:
        others = RowColumns.of_columns(pulses.path, pulses.columns, OWN_COLUMNS)
    for column, reason in others.left_out.items():
        log.warning(f"{pulses.path.name}: column {column} is left out: {reason}")
    return others


def source_print(source: PulseFile) -> dict[str, Any]:
    """Names, sizes and modification times of the input files, and how they are read.

    Pulses in memory have a digest instead.

    Raises
    ------
    CpunetError
        If a file does not exist.
    """
    if source.pulses is not None:
        content = source.pulses.waveforms, source.pulses.energy_kev
        digest = hashlib.sha256(b"".join(values.tobytes() for values in content))
        return {"files": [], "sha256": digest.hexdigest()}
    paths = [source.path]
    elsewhere = (source.energy or "").rpartition(":")[0]
    if elsewhere and Path(elsewhere).is_file():
        paths.append(Path(elsewhere))
    prints = []
    for path in paths:
        try:
            stat = path.stat()
        except OSError:
            raise CpunetError(f"{path}: no such file; check the name") from None
        prints.append({"name": path.name, "bytes": stat.st_size, "changed": stat.st_mtime_ns})
    return {
        "files": prints,
        "table": source.table,
        "energy": source.energy,
        "kev_per_adc": source.kev_per_adc,
        "dt_ns": source.dt_ns,
    }


def finished(out: Path, wanted: dict[str, Any]) -> dict[str, Any]:
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
            found = json.loads(file.attrs[TRANSLATION])
    except (CpunetError, LookupError) as error:
        raise CpunetError(
            f"{out}: is no translation that is finished; choose another `out` or give `force`"
        ) from error
    for what, value in wanted.items():
        if found[what] == value:
            continue
        other = f"another {what}"
        if what == "options":
            theirs = found[what]
            names = [n for n in theirs | value if theirs.get(n, ...) != value.get(n, ...)]
            other = f"other options ({', '.join(names)})"
        raise CpunetError(f"{out}: was made with {other}; choose another `out` or give `force`")
    return dict(found["counts"])
