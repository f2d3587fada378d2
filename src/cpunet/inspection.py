"""Opens whatever this program reads or makes, and says what is in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.outputs import refuse_picture, written_aside
from cpunet.pulses.channels import ALL, channels_of
from cpunet.pulses.reading.files import FileOptions, PulseFile, pulse_file
from cpunet.pulses.reading.source import PulseSource
from cpunet.settings import Set, key_values
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import holds_detector, read_detector
from cpunet.simulation.hits import HitOptions
from cpunet.tables import Lines, aligned, text_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cpunet.recipes.schema import Recipe

    Loaded: TypeAlias = cpunet.Run | cpunet.Report | cpunet.Stand | PulseFile

_DPI = 150
_FIRST_PULSES, _TAILS_BLOCK = 256, 4096  # traces read at a time


@dataclass(frozen=True, eq=False, repr=False)
class InfoResult:
    """What is in a file, a detector or a folder; its text is what the command line prints.

    Parameters
    ----------
    path
        What was looked at.
    lines
        Topics and texts.
    values
        The same as numbers.
    tables
        All tables of a file, if these were wanted, or the reason why one cannot be read.
    ok
        Whether all that was wanted can be read.
    """

    path: str
    lines: Lines = ()
    values: Mapping[str, Any] = field(default_factory=dict)
    tables: Mapping[str, InfoResult | str] = field(default_factory=dict)
    ok: bool = True
    _draw: Callable[[], Figure] | None = None

    def __str__(self) -> str:
        whole = [f"{name}:\n{one}" for name, one in self.tables.items()]
        return "\n".join([aligned(self.lines), *whole] if self.lines else whole)

    def __repr__(self) -> str:
        return f"<InfoResult {self.path}>"

    def plot(self) -> Figure:
        """Draw the spectrum of pulses, or the fields of a detector.

        Raises
        ------
        CpunetError
            If there is neither.
        """
        if self._draw is None:
            raise CpunetError(
                f"{self.path}: no spectrum to draw",
                "give one detector or the `table` of one detector's pulses, or no `out`",
            )
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
    detector: str | Path | Detector | None = None,
    frame: HitOptions = HitOptions(),
    settings: Set = (),
    out: str | Path | None = None,
    force: bool = False,
) -> InfoResult:
    """Say what is in a file, detector, run, stand or report.

    Of pulses: events, sampling, energies, peaks and provenance; of measured traces, also
    trigger, baseline, decay, noise, saturation and pile-up, and what earlier pulses have left
    under them. Of hits: events, energies and where they lie. Of a detector: its capacitance,
    depletion voltage and fields. Of a run: what was trained on what, and how well it fits.

    Parameters
    ----------
    path
        File of pulses or hits, a detector (icpc, bege, ppc, a YAML file, a siggen configuration
        or LEGEND metadata), or the folder of a run, stand or report.
    read
        How a file of pulses is read.
    detector
        Crystal of hits (icpc, bege, ppc or a file): how many lie outside.
    frame
        How a file of hits is read.
    settings
        Override a value of the detector looked at: bias_V=3500 (repeatable).
    out
        Figure of the spectrum and its lines, or of the fields: .png, .pdf or .svg.
    force
        Replace an existing figure.

    Raises
    ------
    CpunetError
        If there is no such file, it cannot be read, or the figure cannot be made.

    Examples
    --------
    cpunet info raw.lh5 --out raw.png

    cpunet info raw.lh5 --table all

    cpunet info icpc --set bias_V=3500 --out icpc.png

    cpunet info hits.npz --detector icpc
    """
    if out is not None:
        given = None if isinstance(detector, Detector) else detector
        refuse_picture(Path(out), path, read.energy, given, force=force)
    found = _look(path, read, detector, frame, key_values(settings))
    if out is not None:
        found.save(out, force)
    return found


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
    if (path / "run.json").is_file():
        return cpunet.Run.load(path)
    if (path / "metrics.json").is_file():
        return cpunet.Report.load(path)
    if (path / "stand.json").is_file():
        return cpunet.Stand.load(path)
    raise CpunetError(
        f"{path}: no folder of this program",
        "give the folder of a run, which holds run.json, of a report or stand, or a file",
    )


def _look(
    path: str | Path,
    read: FileOptions,
    crystal: str | Path | Detector | None,
    frame: HitOptions,
    settings: Mapping[str, Any],
) -> InfoResult:
    if holds_detector(path):
        return _detector(read_detector(path, settings), str(path))
    if settings:
        raise CpunetError(f"{path}: is no detector", "leave out `settings`")
    if Path(path).is_dir():
        return _folder(path)
    from cpunet.recipes import load_recipe
    from cpunet.simulation.hit_files import describe_hits, holds_hits

    recipe = load_recipe("fast")
    if holds_hits(path):
        told: dict[str, Any] = {}
        inside = None if crystal is None else read_detector(crystal)
        hits = describe_hits(Path(path), frame, recipe.peaks, inside)
        lines = [("file", str(path))]
        for name, one in hits.items():
            lines.append(("detector", name))
            lines += [("hits", one)] if isinstance(one, str) else one.lines
            told[name] = one if isinstance(one, str) else asdict(one)
        return InfoResult(str(path), lines, told)
    return _file(pulse_file(path, read), recipe)


def _folder(path: str | Path) -> InfoResult:
    found = load(path)
    if isinstance(found, cpunet.Run):
        return InfoResult(str(path), found.summary())
    if verdicts := getattr(found, "verdicts", None):
        return InfoResult(str(path), [("report", str(path)), *(("", v) for v in verdicts)])
    return InfoResult(str(path), [("", str(found))])


def _detector(detector: Detector, path: str) -> InfoResult:
    from cpunet.progress import stage
    from cpunet.simulation.fields import compute_fields, fields_in_words

    with stage(f"Fields of {detector.name}"):
        fields = compute_fields(detector)

    def draw() -> Figure:
        from cpunet.simulation.detector_figure import detector_figure

        return detector_figure(detector, fields)

    values = {
        "capacitance_pF": fields.capacitance_pF,
        "depletion_V": fields.depletion_V,
        "impurity_scale": detector.impurity_scale,
    }
    return InfoResult(path, fields_in_words(detector, fields), values, _draw=draw)


def _file(file: PulseFile, recipe: Recipe) -> InfoResult:
    from cpunet.pulses.reading.files import table_sizes

    path = str(file.path)
    if file.table == ALL:
        channels: dict[str, InfoResult | str] = {}
        for name, one in channels_of(file).items():
            try:
                channels[name] = _pulses(one, recipe)
            except CpunetError as error:
                channels[name] = str(error).removeprefix(f"{path}: ")
        ok = not any(isinstance(one, str) for one in channels.values())
        return InfoResult(path, tables=channels, ok=ok)
    tables = table_sizes(file.path) if file.table is None else {}
    if len(tables) < 2:
        return _pulses(file, recipe)
    values: dict[str, Any] = {}
    rows = []
    for name, number in tables.items():
        try:
            source = replace(file, table=name).open()
        except CpunetError as error:
            values[name] = str(error).removeprefix(f"{path}: ")
            rows.append([name, "", "", "", values[name]])
        else:
            n, energy = number or source.n_pulses, source.energies.description
            values[name] = {"n_pulses": n, "length": source.length}
            values[name] |= {"dt_ns": source.dt_ns, "energy": energy}
            rows.append([name, n, source.length, f"{source.dt_ns:g}", energy])
    text = text_table(["table", "traces", "samples", "ns", "energies"], rows)
    lines = [("", text), ("", "one of them: `table` NAME; each in full: `table` all")]
    return InfoResult(path, lines, values)


def _pulses(file: PulseFile, recipe: Recipe) -> InfoResult:
    """Describe the pulses of one table."""
    from cpunet.pulses.description import describe_pulses
    from cpunet.pulses.spectrum import spectrum_figure

    source = file.open()
    found, spectrum = describe_pulses(source, recipe.peaks)
    told: dict[str, Any] = {k: v for k, v in asdict(found).items() if v not in ("", {})}
    lines = found.lines
    if _is_measured(source):
        more, words = _traces(source, recipe)
        told, lines = told | more, lines + words
    some = bool(np.isfinite(spectrum.values).any())
    draw = partial(spectrum_figure, spectrum) if some else None
    return InfoResult(str(file.path), lines, told, _draw=draw)


def _is_measured(source: PulseSource) -> bool:
    """Whether they are raw traces, by what the file records or by the shape of the pulses."""
    from cpunet.pulses.provenance import apparent_side, recorded_side

    found = recorded_side(source)
    if found is None:
        first = next(iter(source.blocks(_FIRST_PULSES)), None)
        found = None if first is None else apparent_side(first.waveforms)
    # translated windows look measured, but are not raw traces
    return found is not None and found.side == "measured" and "translated" not in found.why


def _traces(
    source: PulseSource, recipe: Recipe
) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Properties of measured traces, and the pile-up tails under them."""
    from cpunet.electronics.pile_up_tails import PileUpTails, tails_in_words
    from cpunet.pulses.baselines import Baselines
    from cpunet.pulses.description import BLOCK, trace_properties

    told: dict[str, Any] = {}
    try:
        traces = trace_properties(source.blocks(BLOCK), recipe)
        told["traces"], lines = asdict(traces), traces.lines
    except CpunetError as error:
        told["traces"] = f"cannot be described: {error}"
        lines = [("", told["traces"])]
    try:
        baselines = Baselines.of(source.blocks(_TAILS_BLOCK), recipe.preparation)
        told["tails"] = PileUpTails.of(baselines).describe()
        lines += tails_in_words(told["tails"])
    except CpunetError as error:
        told["tails"] = f"not known: {error}"
        lines += [("pile-up tails", told["tails"])]
    return told, lines
