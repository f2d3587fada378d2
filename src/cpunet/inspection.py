"""Opens whatever this program reads or makes, and says what is in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import cpunet
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_picture, written_aside
from cpunet.pulses import provenance
from cpunet.pulses.reading.files import ALL, FileOptions, PulseFile, pulse_file, table_sizes
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.settings import Set, key_values
from cpunet.simulation.geometry_readers import holds_detector, read_detector
from cpunet.simulation.hit_files import describe_hits, holds_hits
from cpunet.tables import Lines, aligned, text_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    Loaded: TypeAlias = cpunet.Run | cpunet.Report | cpunet.Stand | PulseFile

_DPI = 150


@dataclass(frozen=True, eq=False, repr=False)
class InfoResult:
    """What is in a file, a detector or a folder; its text is what the command line prints.

    Parameters
    ----------
    path
        What was looked at.
    lines
        Topics and texts.
    ok
        Whether all that was wanted can be read.
    """

    path: str
    lines: Lines
    ok: bool = True
    _draw: Callable[[], Figure] | None = None

    def __str__(self) -> str:
        return aligned(self.lines)

    def __repr__(self) -> str:
        return f"<InfoResult {self.path}>"

    def plot(self) -> Figure:
        """Draw the fields of a detector.

        Raises
        ------
        CpunetError
            If it is none.
        """
        if self._draw is None:
            raise CpunetError(f"{self.path}: is no detector to draw", "leave out `out`")
        return self._draw()

    def save(self, path: str | Path, force: bool = False) -> None:
        """Write the figure as ``.png``, ``.pdf`` or ``.svg``.

        Raises
        ------
        CpunetError
            If the file exists and `force` is off, or there is no figure.
        """
        path = Path(path)
        refuse_picture(path, self.path, force=force)
        figure = self.plot()
        with written_aside(path) as aside:
            figure.savefig(aside, format=path.suffix[1:].lower(), dpi=_DPI)


def info(
    path: str | Path,
    *,
    read: FileOptions = FileOptions(),
    units: str = "",
    settings: Set = (),
    quality: bool = False,
    out: str | Path | None = None,
    force: bool = False,
) -> InfoResult:
    """Say what is in a file, detector, run, stand or report.

    Of pulses: events, sampling, energies, peaks and provenance; of measured traces, also
    decay and noise, and on request what quality cuts leave out, and pile-up tails. Of hits:
    events, energies and where they lie. Of a detector: its capacitance, depletion voltage and
    fields. Of a run: what was trained on what, and how well it fits.

    Parameters
    ----------
    path
        File of pulses or hits, a detector (icpc, bege, ppc, a YAML file, a siggen configuration
        or LEGEND metadata), or the folder of a run, stand or report.
    read
        How a file of pulses is read.
    units
        Units of lengths and energies that a file of hits does not name, as ``cm,keV``.
    settings
        Override a value of the detector looked at: bias_V=3500 (repeatable).
    quality
        Of measured traces also what quality cuts leave out, and pile-up tails: some seconds.
    out
        Figure of the fields of a detector: .png, .pdf or .svg.
    force
        Replace an existing figure.

    Raises
    ------
    CpunetError
        If there is no such file, it cannot be read, or the figure cannot be made.

    Examples
    --------
    cpunet info raw.lh5 --table all

    cpunet info raw.lh5 --quality

    cpunet info icpc --set bias_V=3500 --out icpc.png

    cpunet info hits.csv --units mm,keV
    """
    place, values, recipe = Path(path), key_values(settings), load_recipe("fast")
    if out is not None:
        refuse_picture(Path(out), path, read.energy, force=force)
    if holds_detector(path):
        from cpunet.simulation.fields import compute_fields, fields_in_words

        detector = read_detector(path, values)
        fields = compute_fields(detector)

        def draw() -> Figure:
            from cpunet.simulation.detector_figure import detector_figure

            return detector_figure(detector, fields)

        of_detector = InfoResult(str(path), fields_in_words(detector, fields), _draw=draw)
        if out is not None:
            of_detector.save(out, force)
        return of_detector
    if out is not None or values:
        raise CpunetError(f"{path}: is no detector", "leave out `settings` and `out`")
    if place.is_dir():
        content = load(path)
        if isinstance(content, cpunet.Run):
            return InfoResult(str(path), content.summary())
        verdicts = getattr(content, "verdicts", None)
        lines = [("report", str(path)), *(("", verdict) for verdict in verdicts or ())]
        return InfoResult(str(path), lines if verdicts else [("", str(content))])
    try:
        return _file(pulse_file(path, read), recipe, quality)
    except CpunetError:
        if not holds_hits(path):
            raise
    lines = [("file", str(path))]
    for name, topics in describe_hits(place, recipe.peaks, units).items():
        lines += [("detector", name), *topics]
    return InfoResult(str(path), lines)


def load(path: str | Path) -> Loaded:
    """Open what this program reads or makes.

    Parameters
    ----------
    path
        Folder of a run, report or stand, or a file of pulses.

    Returns
    -------
    Run, Report, Stand or PulseFile

    Raises
    ------
    CpunetError
        If it is none of these, or cannot be read.
    """
    path = Path(path)
    if not path.is_dir():
        file = PulseFile(path)
        file.open()
        return file
    for name, kind in (
        ("run.json", cpunet.Run), ("metrics.json", cpunet.Report), ("stand.json", cpunet.Stand),
    ):  # fmt: skip
        if (path / name).is_file():
            return kind.load(path)
    raise CpunetError(
        f"{path}: no folder of this program",
        "give the folder of a run, which holds run.json, of a report or stand, or a file",
    )


def _file(file: PulseFile, recipe: Recipe, quality: bool) -> InfoResult:
    path = str(file.path)
    if file.table == ALL:
        from cpunet.pulses.channels import channels_of  # processes, bars

        texts, ok = [], True
        for name, channel in channels_of(file).items():
            try:
                text = aligned(_pulses(channel, recipe, quality))
            except CpunetError as error:
                text, ok = str(error).removeprefix(f"{path}: "), False
            texts.append(("", f"{name}:\n{text}"))
        return InfoResult(path, texts, ok)
    try:
        return InfoResult(path, _pulses(file, recipe, quality))
    except CpunetError:
        tables = table_sizes(file.path) if file.table is None else {}
        if len(tables) < 2:
            raise
    rows: list[list[object]] = []
    for name, number in tables.items():
        try:
            with replace(file, table=name).open() as source:
                numbers = [number or source.n_pulses, source.length, f"{source.dt_ns:g}"]
                rows.append([name, *numbers, source.energies])
        except CpunetError as error:
            rows.append([name, "", "", "", str(error).removeprefix(f"{path}: ")])
    text = text_table(["table", "traces", "samples", "ns", "energies"], rows)
    return InfoResult(
        path, [("", text), ("", "one of them: `table` NAME; each in full: `table` all")]
    )


def _pulses(file: PulseFile, recipe: Recipe, quality: bool) -> Lines:
    """Describe the pulses of one table; of measured traces also their quality, on request."""
    with file.open() as source:
        blocks = source.blocks()
        first = next(blocks)  # a few thousand
        lines = provenance.describe_pulses(source, chain([first], blocks), recipe.peaks)
        side = provenance.recorded_side(source) or provenance.apparent_side(first.waveforms)
        # translated windows look measured, but are not raw traces
        translated = source.attrs.get(provenance.TRANSLATED_BY)
        if side is None or side.side != "measured" or translated:
            return lines
        try:
            lines += provenance.trace_properties(first, recipe.preparation)
        except CpunetError as error:
            lines.append(("", f"cannot be described: {error}"))
        rolled = provenance.rolled_over(first.waveforms)
        lines.append(("odd", "" if rolled is None else rolled.text))
        if not quality:
            return [*lines, ("", "what cuts leave out, and pile-up tails: `quality`")]
        from cpunet.electronics.pile_up_tails import PileUpTails
        from cpunet.pulses.baselines import Baselines

        lines.append(("left out", provenance.left_out(first, recipe)))
        try:
            baselines = Baselines.of(source.blocks(), recipe.preparation)
            return lines + PileUpTails.of(baselines).describe().in_words()
        except CpunetError as error:
            return [*lines, ("pile-up tails", f"not known: {error}")]
