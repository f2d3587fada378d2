"""Describe the content of a file of pulses or of a run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import cpunet
from cpunet.electronics.remains import Remains
from cpunet.errors import CpunetError
from cpunet.jobs.inspection.hits_info import Units, describe_hits
from cpunet.jobs.inspection.provenance import provenance
from cpunet.jobs.inspection.trace_properties import BLOCK, trace_properties
from cpunet.outputs import PICTURE_FORMATS, refuse_existing, written_aside
from cpunet.pulses.channels import ALL, channels_of
from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import label_peaks
from cpunet.pulses.preparation import Kind
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.reading.energies import amplitude
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.reading.opening import table_sizes
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.side import MADE_BY, SIDE, apparent_side, recorded_side
from cpunet.pulses.spectrum import Spectrum, Values, suggested_calibration
from cpunet.recipes.schema import PeakConfig, Recipe
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_readers import holds_hits

_RUN_FILE = "run.json"
# what other folders are, by a file that they hold
_NO_RUNS = {
    "stand.json": "a virtual test stand, whose sim.lh5 and data.lh5 can be given; ",
    "report.html": "a report, to be opened in a browser (report.html); ",
}
DPI = 150
LOOKED_AT, REMAINS_BLOCK = 256, 4096  # traces read at a time


def describe(
    path: str | Path,
    *,
    table: str | None = None,
    energy: str | None = None,
    kev_per_adc: float | None = None,
    dt_ns: float | None = None,
    recipe: Recipe | None = None,
    detector: Detector | None = None,
    hit_units: Units = (None, None),
    without_remains: Path | None = None,
    out: Path | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Describe the content of a file of pulses or of the folder of a training run.

    A file is read in blocks; only energies or amplitudes of all pulses are held in memory.

    Parameters
    ----------
    path
        File of pulses, or folder with ``run.json``.
    table, energy, kev_per_adc, dt_ns
        See `cpunet.pulses.reading.open_pulses`. With ``"all"`` as table all are described.
    recipe
        Recipe with the gamma lines to count and the preparation to describe measured traces.
    detector
        Crystal in which hits should lie.
    hit_units
        Units of lengths and energies of hits, if the file names none.
    without_remains
        LH5 file to write: the traces after subtraction of their remains, with columns
        ``remains_kev`` and ``remains_error_kev``.
    out
        Figure of the spectrum to write: ``.png``, ``.pdf`` or ``.svg``.
    force
        Whether to replace these files.

    Returns
    -------
    dict
        For a run, ``kind`` (``"run"``), ``path`` and ``run``.
        For a file of hits, the result of `describe_hits`.
        For a file with several tables, none of them chosen, ``kind`` (``"tables"``),
        ``path`` and ``tables``: the result of `PulseSource.describe` by name, or the reason
        why a table cannot be read.
        For all tables of a file, ``kind`` (``"channels"``), ``path`` and ``channels``: the
        description of each table, or the reason why it cannot be read.
        For a file, ``kind`` (``"pulses"``), ``path``, the result of `PulseSource.describe`,
        and: ``n_pulses``; ``energy_kev`` (lowest and highest, None if unknown) and
        ``n_without_energy``; ``peaks`` (number of pulses by line); ``amplitudes``, a
        suggested calibration if no energy is known, or else ``found``, the source whose lines
        are there, and at which share of their energies; ``samples`` (lowest and highest of the
        finite traces); the numbers ``n_not_finite`` and ``n_constant`` of traces;
        ``provenance``, if the file records it; for measured traces with a `recipe`,
        ``traces``, the result of `trace_properties`, and ``remains``, that of
        `Remains.describe`, or the reason why there is none.

    Raises
    ------
    CpunetError
        If the file does not exist or cannot be read, a file to be written exists, remains
        are to be subtracted but cannot be estimated, or there is not one spectrum to draw.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(Path(folder) / "pulses.npy", np.zeros((3, 8)))
    ...     told = describe(Path(folder) / "pulses.npy", dt_ns=16)
    >>> told["n_pulses"], told["length"], told["n_constant"]
    (3, 8, 3)
    """
    path = Path(path)
    if out is not None and out.suffix.lower() not in PICTURE_FORMATS:
        raise CpunetError(f"{out}: pictures are made as {', '.join(PICTURE_FORMATS)}")
    for target in (without_remains, out):
        if target is not None:
            refuse_existing(target, path, energy, force=force)
    if (
        out is not None
        and without_remains is not None
        and out.resolve() == without_remains.resolve()
    ):
        raise CpunetError(
            f"{out}: is given for the figure and for the traces; choose another --out"
        )
    spectrum: Spectrum | None = None
    if path.is_dir():
        if without_remains is not None:
            raise CpunetError(f"{path}: a run has no traces; leave out --without-remains")
        told = _run(path)
    elif holds_hits(path) and without_remains is None:
        chosen = None if table == ALL else table
        peaks = recipe.peaks if recipe else {}
        told = describe_hits(path, chosen, peaks, detector, hit_units)
    else:
        file = PulseFile(path, table, energy, kev_per_adc, dt_ns)
        told, spectrum = _of_file(file, recipe, without_remains, force=force)
    if out is not None:
        if spectrum is None or not np.isfinite(spectrum.values).any():
            raise CpunetError(
                f"{path}: no spectrum to draw; give the --table of one detector's pulses, or "
                "leave out --out"
            )
        from cpunet.validation.spectrum_figure import spectrum_figure  # loads matplotlib

        figure = spectrum_figure(spectrum)
        with written_aside(out) as aside:
            figure.savefig(aside, format=out.suffix[1:].lower(), dpi=DPI)
    return told


def _of_file(
    file: PulseFile, recipe: Recipe | None, without_remains: Path | None, *, force: bool
) -> tuple[dict[str, Any], Spectrum | None]:
    """Describe a file of pulses; also return its spectrum if one table was read."""
    if file.table == ALL and without_remains is None:
        channels: dict[str, Any] = {}
        for name, one in channels_of(file).items():
            try:
                channels[name], _ = _of_pulses(one, recipe)
            except CpunetError as error:
                channels[name] = str(error).removeprefix(f"{file.path}: ")
        return {"kind": "channels", "path": str(file.path), "channels": channels}, None
    tables = table_sizes(file.path) if file.table is None else {}
    if len(tables) > 1 and without_remains is None:
        told = {"tables": _told_of(file.path, tables, file.dt_ns)}
        return {"kind": "tables", "path": str(file.path), **told}, None
    return _of_pulses(file, recipe, without_remains, force=force)


def _of_pulses(
    file: PulseFile,
    recipe: Recipe | None,
    without_remains: Path | None = None,
    *,
    force: bool = False,
) -> tuple[dict[str, Any], Spectrum]:
    """Describe the pulses of one table; also return their spectrum."""
    path, source = file.path, file.open()
    peaks = recipe.peaks if recipe else {}
    counts = _Counts(dict.fromkeys(peaks, 0))
    for block in source.blocks():
        counts.add(block, peaks)
    spectrum = counts.spectrum()
    told = {
        "kind": "pulses",
        "path": str(path),
        **source.describe(),
        **counts.summary(spectrum),
    }
    made = provenance(source)
    told |= {"provenance": made} if made else {}
    if recipe is None or _side(source) != "measured":
        if without_remains is not None:
            raise CpunetError(f"{path}: remains are taken off measured traces; these are none")
        return told, spectrum
    try:
        told["traces"] = trace_properties(source.blocks(BLOCK), recipe)
    except CpunetError as error:
        told["traces"] = f"cannot be described: {error}"
    try:
        remains = Remains.of_traces(source.blocks(REMAINS_BLOCK), recipe.preparation)
    except CpunetError as error:
        if without_remains is not None:
            raise CpunetError(f"{path}: {error}") from error
        return told | {"remains": f"not known: {error}"}, spectrum
    if without_remains is not None:
        _write_without(source, remains, without_remains, force=force)
    return told | {"remains": remains.describe()}, spectrum


def _told_of(
    path: Path, tables: Mapping[str, int | None], dt_ns: float | None
) -> dict[str, Any]:
    """Description of each table without reading its traces, or why it cannot be read."""
    told: dict[str, Any] = {}
    for table, counted in tables.items():
        try:
            source = open_pulses(path, table=table, dt_ns=dt_ns)
        except CpunetError as error:
            told[table] = str(error)
        else:
            told[table] = source.describe()
            if counted is not None:
                told[table]["n_pulses"] = counted
    return told


def _side(source: PulseSource) -> Kind | None:
    """Measured or simulated, according to the file or to the shape of its pulses."""
    found = recorded_side(source)
    if found is None:
        first = next(iter(source.blocks(LOOKED_AT)), None)
        found = None if first is None else apparent_side(first.waveforms)
    # translated windows look measured, but are not raw traces
    return None if found is None or "translated" in found.why else found.side


def _write_without(source: PulseSource, remains: Remains, out: Path, *, force: bool) -> None:
    """Write the traces after subtraction of their remains, with the remains as columns."""
    from cpunet.pulses.writing import PulseWriter  # loads the LH5 library: a second

    attrs = {MADE_BY: f"cpunet info {cpunet.__version__}", SIDE: "measured"}
    with PulseWriter(
        out, table="geds/raw", waveform_units="ADC", attrs=attrs, force=force
    ) as writer:
        for block in source.blocks(REMAINS_BLOCK):
            kev = remains.measure(block)
            error = np.where(np.isfinite(kev), remains.error_kev, np.nan)
            columns = {"remains_kev": (kev, "keV"), "remains_error_kev": (error, "keV")}
            writer.append(remains.subtracted_from(block), columns)


@dataclass
class _Counts:
    """Sums and extremes over blocks."""

    peaks: dict[str, int]
    n_pulses: int = 0
    n_without_energy: int = 0
    n_not_finite: int = 0
    n_constant: int = 0
    amplitudes: list[Values] = field(default_factory=list)
    energies: list[Values] = field(default_factory=list)
    energy_kev: list[float] = field(default_factory=list)
    samples: list[float] = field(default_factory=list)

    def add(self, block: Pulses, peaks: Mapping[str, PeakConfig]) -> None:
        self.n_pulses += len(block)
        known = block.energy_kev[np.isfinite(block.energy_kev)]
        self.n_without_energy += len(block) - len(known)
        if len(known):
            self.energies.append(known)
        else:
            self.amplitudes.append(amplitude(block.waveforms))
        self.energy_kev = _range([*self.energy_kev, *_extremes(known)])
        names, counts = np.unique(label_peaks(known, peaks), return_counts=True)
        for name, count in zip(names, counts, strict=True):
            if name:
                self.peaks[str(name)] += int(count)
        # A sum is NaN or infinite if any sample is; this needs no mask as large as the block.
        with np.errstate(invalid="ignore", over="ignore"):
            finite = np.isfinite(block.waveforms.sum(axis=1, dtype=np.float64))
        self.n_not_finite += int((~finite).sum())
        good = block.waveforms if finite.all() else block.waveforms[finite]
        low, high = good.min(axis=1), good.max(axis=1)
        self.n_constant += int((low == high).sum())
        self.samples = _range([*self.samples, *_extremes(low), *_extremes(high)])

    def spectrum(self) -> Spectrum:
        """Energies of the pulses, or their amplitudes if no energy is known, with lines."""
        known = bool(self.energies)
        values = np.concatenate(self.energies or self.amplitudes or [np.empty(0)])
        return Spectrum(values, in_kev=known, found=suggested_calibration(values))

    def summary(self, spectrum: Spectrum) -> dict[str, Any]:
        found = spectrum.found
        lines = {} if spectrum.in_kev else {"amplitudes": "no lines that stand out"}
        if found is not None and spectrum.in_kev:
            place = 1 / found.kev_per_adc
            lines = {"found": f"lines of {found.source}, at {place:.4f} of their energies"}
        elif found is not None:
            lines = {"amplitudes": f"like {found}"}
        return {
            "n_pulses": self.n_pulses,
            "energy_kev": self.energy_kev or None,
            "n_without_energy": self.n_without_energy,
            "peaks": self.peaks,
            **lines,
            "samples": self.samples or None,
            "n_not_finite": self.n_not_finite,
            "n_constant": self.n_constant,
        }


def _extremes(values: np.typing.NDArray[Any]) -> list[float]:
    return [float(values.min()), float(values.max())] if values.size else []


def _range(values: list[float]) -> list[float]:
    return [min(values), max(values)] if values else []


def _run(folder: Path) -> dict[str, Any]:
    if not (folder / _RUN_FILE).is_file():
        hint = next((hint for name, hint in _NO_RUNS.items() if (folder / name).is_file()), "")
        raise CpunetError(
            f"{folder}: {hint}a folder without {_RUN_FILE}; give the folder of a run, or a file"
        )
    from cpunet.training.run import Run  # loads torch, which files do not need

    return {"kind": "run", "path": str(folder), "run": Run.load(folder)}
