"""A file of pulses and how it is read: its first bytes show its format."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.tables import shortened

if TYPE_CHECKING:
    from cpunet.pulses.reading.source import PulseSource


ALL = "all"  # in place of the name of a table
_ROWS = re.compile(r"(?:(.+)/)?(\w+=[^,/=]+(?:,\w+=[^,/=]+)*)")  # as raw/channel=3
_OPTIONS = ("table", "energy", "kev_per_adc", "dt_ns")  # which a run stores


@dataclass(frozen=True)
class FileOptions:
    """How a file of pulses is read, if it does not tell itself.

    Parameters
    ----------
    table
        Table of the pulses, if the file has several, or rows in it, as ``raw/channel=3``;
        ``all``: every table separately.
    energy
        Energy column, or ``FILE:path/to/column``, as of a hit tier.
    kev_per_adc
        Calibration of pulses without energies in keV: keV per ADC count.
    dt_ns
        Sampling period in ns.
    """

    table: str | None = None
    energy: str | None = None
    kev_per_adc: float | None = None
    dt_ns: float | None = None


@dataclass(frozen=True)
class ReadOptions:
    """How the files of both sides are read, if they do not tell themselves.

    Parameters
    ----------
    data_table
        Table of the measured pulses, if the file has several, or rows in it, as
        ``raw/channel=3``; ``all``: every table separately.
    data_energy
        Energy column of the data, or ``FILE:path/to/column``, as of a hit tier.
    kev_per_adc
        Calibration of measured pulses without energies in keV: keV per ADC count.
    dt_ns
        Sampling period in ns.
    sim_table
        Table of the simulated pulses, if the file has several.
    insist
        Skip the check whether pulses are simulated or measured.
    """

    data_table: str | None = None
    data_energy: str | None = None
    kev_per_adc: float | None = None
    dt_ns: float | None = None
    sim_table: str | None = None
    insist: bool = False

    def files(self, sim: Source, data: Source) -> tuple[PulseFile, PulseFile]:
        """Files of both sides, see `pulse_file`; the simulated pulses are in keV."""
        of_sim = FileOptions(self.sim_table, None, None, self.dt_ns)
        of_data = FileOptions(self.data_table, self.data_energy, self.kev_per_adc, self.dt_ns)
        return pulse_file(sim, of_sim, self.insist), pulse_file(data, of_data, self.insist)


@dataclass(frozen=True)
class PulseFile:
    """A file of pulses and how it is read; see `cpunet.open_pulses`.

    Parameters
    ----------
    path
        The file.
    table, energy, kev_per_adc, dt_ns
        As of `FileOptions`.
    insist
        Skip the check whether pulses are simulated or measured.
    pulses
        Pulses in memory, which are read in place of a file.

    Attributes
    ----------
    place, rows
        The table alone, and values of the columns by which rows of it are chosen.
    """

    path: Path
    table: str | None = None
    energy: str | None = None
    kev_per_adc: float | None = None
    dt_ns: float | None = None
    insist: bool = False
    pulses: Pulses | None = None
    place: str | None = field(init=False, compare=False)
    rows: dict[str, str] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        match = _ROWS.fullmatch(self.table or "")
        pairs = [] if match is None else [pair.split("=") for pair in match[2].split(",")]
        object.__setattr__(self, "path", Path(self.path))  # users may give text
        object.__setattr__(self, "place", self.table if match is None else match[1])
        object.__setattr__(self, "rows", dict(pairs))
        for name in ("kev_per_adc", "dt_ns"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise CpunetError(f"{self.path}: {name} is {value}; expected more than 0")

    def __repr__(self) -> str:
        options = "".join(f", {name} {value}" for name, value in self.options.items())
        return f"<PulseFile {self.path}{options}>"

    def __bool__(self) -> bool:
        return True  # without a look at the file

    def __len__(self) -> int:
        with self.open() as source:
            return source.n_pulses or sum(map(len, source.blocks()))

    def __iter__(self) -> Iterator[Pulses]:
        """Blocks of a few thousand pulses."""
        with self.open() as source:
            yield from source.blocks()

    def __getitem__(self, rows: slice) -> Pulses:
        """The pulses of some rows; others are not read, where the format allows it."""
        with self.open() as source:
            if (n := source.n_pulses) is None:
                return source.read()[rows]
            if not (picked := range(n)[rows]):
                return source.read(0, 1)[:0]
            first, last = sorted((picked[0], picked[-1]))
            return source.read(first, last + 1)[:: picked.step]

    @property
    def waveforms(self) -> FloatArray:
        """Waveforms of all pulses, shape ``(n, samples)``, read on every access."""
        return self[:].waveforms

    @property
    def energy_kev(self) -> npt.NDArray[np.float64]:
        """Energies of all pulses in keV, read on every access."""
        return self[:].energy_kev

    @property
    def files(self) -> tuple[Path | str | None, ...]:
        """Paths that are read, for `cpunet.outputs.refuse_inputs`."""
        return () if self.pulses is not None else (self.path, self.energy)

    @property
    def options(self) -> dict[str, str | float]:
        """The reading options given by the user."""
        given = {name: getattr(self, name) for name in _OPTIONS}
        return {name: value for name, value in given.items() if value is not None}

    def chosen_of(self, tables: list[str], kind: str, kinds: str) -> str:
        """The table that the user chose, or the only table.

        Parameters
        ----------
        tables
            Tables in the file, at least one.
        kind, kinds
            What a table and several are called.

        Raises
        ------
        CpunetError
            If there is no such table, or there are several and none was chosen.
        """
        place = tables[0] if self.place is None and len(tables) == 1 else self.place
        if place in tables:
            return place
        if place is not None:
            raise CpunetError(f"{self.path}: no {kind} {place}; there are {shortened(tables)}")
        remedy = "choose one with `table` (`sim_table`, `data_table`)"
        raise CpunetError(f"{self.path}: {len(tables)} {kinds} ({shortened(tables)})", remedy)

    def open(self) -> PulseSource:
        """Open the file, or the pulses in memory; see `cpunet.open_pulses`."""
        # HDF5 takes a fifth of a second to import
        format_ = "memory" if self.pulses is not None else recognise(self.path)
        if format_ == "HDF5":
            from cpunet.pulses.reading.hdf5 import read_hdf5

            return read_hdf5(self).resolve(self)
        from cpunet.pulses.reading.other_formats import READERS

        return READERS[format_](self).resolve(self)


Source: TypeAlias = str | Path | PulseFile | Pulses


def pulse_file(
    source: Source, options: FileOptions = FileOptions(), insist: bool = False
) -> PulseFile:
    """A file of pulses from what a user gives: a path, a `PulseFile`, or `Pulses` in memory.

    Raises
    ------
    CpunetError
        If it is none of these, or options are given for what has its own.
    """
    how = asdict(options) | {"insist": insist}
    if isinstance(source, str | Path):
        return PulseFile(Path(source), **how)
    if not isinstance(source, PulseFile | Pulses):
        give = (
            "give a path, a cpunet.PulseFile, or cpunet.Pulses.of(array, dt_ns=…, energy_kev=…)"
        )
        raise CpunetError(f"{type(source).__name__}: are no pulses", give)
    if given := ", ".join(name for name, value in how.items() if value):
        remedy = "give it to the PulseFile, or leave it out"
        raise CpunetError(f"{given}: is an option of a path", remedy)
    in_memory = Path("pulses in memory")
    return source if isinstance(source, PulseFile) else PulseFile(in_memory, pulses=source)


# First bytes of each format
_FORMATS = {
    "HDF5": rb"(.{512})?\x89HDF\r\n\x1a\n",  # MATLAB writes 512 bytes of its own before it
    "FlashCam": rb".{4}FlashCam",
    "NumPy": rb"\x93NUMPY|PK\x03\x04",
    "pickle": rb"\x80[\2-\5]",
}
_AS_NPZ = "numpy.savez(FILE, waveform=…, energy_kev=…, dt_ns=…)"
_FOREIGN = {  # what cannot be read, and what to do
    rb"root": ("ROOT", f"read its traces with uproot, write them with {_AS_NPZ}"),
    rb"MATLAB 5\.0": ("MATLAB 5", "save it with -v7.3"),
    rb"PAR1": ("Parquet", f"write it with {_AS_NPZ}"),
    rb"\x1f\x8b|BZh|\xfd7zXZ|\x28\xb5\x2f\xfd": ("compressed", "unpack it"),
    rb"[\xe0-\xef]\xca": ("CAEN CoMPASS", "convert it with legend-daq2lh5"),
}
_HEAD_BYTES = 520


def open_pulses(
    path: str | Path,
    *,
    table: str | None = None,
    energy: str | None = None,
    kev_per_adc: float | None = None,
    dt_ns: float | None = None,
) -> PulseSource:
    """Open a file of pulses; the format is recognised by its content.

    Supported formats are LH5 (waveform tables, plain or encoded) and other HDF5, FlashCam
    ``.fcio``, NumPy ``.npz`` and ``.npy``, and CPU-Net's pickled pulses.

    Parameters
    ----------
    path
        The file.
    table
        Location of the waveforms, needed only if there are several: a table or waveform
        column of an LH5 file, a group or dataset of an HDF5 file, an array of an ``.npz``, a
        channel of an ``.fcio``.  Rows of a table that holds several channels are chosen by a
        column, as ``raw/channel=3``.
    energy
        Column of the energies, or ``FILE:path/to/column`` for a column of another
        HDF5 file of the same events, such as LEGEND's hit tier.
    kev_per_adc
        Calibration: keV per unit of the energy column, or of the amplitude (maximum above
        the baseline) if there is no such column.
    dt_ns
        Sampling period in ns, if it is not in the file.

    Returns
    -------
    PulseSource
        Source of blocks of `Pulses`, with energies in keV (NaN if unknown).

    Raises
    ------
    CpunetError
        If the file is missing, of an unknown format, damaged or without pulses, if `table` or
        `energy` is missing or wrong, or if the file contradicts `dt_ns` or `kev_per_adc`.
    """
    return PulseFile(Path(path), table, energy, kev_per_adc, dt_ns).open()


def table_sizes(path: str | Path) -> dict[str, int | None]:
    """Waveform tables of an LH5 or other HDF5 file; none of formats without tables.

    For FlashCam files these are the channels with traces.

    Returns
    -------
    dict
        Number of pulses of each if it had to be counted, else None.

    Raises
    ------
    CpunetError
        If the file is missing or cannot be read.
    """
    path = Path(path)
    if (format_ := recognise(path)) == "FlashCam":
        from cpunet.pulses.reading.other_formats import channel_sizes

        return channel_sizes(path)
    if format_ != "HDF5":
        return {}
    from cpunet.pulses.reading.hdf5 import channel_tables

    return dict.fromkeys(channel_tables(path))


def recognise(path: Path) -> str:
    """Return the name of the format of a file, from its content.

    Raises
    ------
    CpunetError
        If there is no such file, or it is a folder, empty, or of an unknown format.
    """
    try:
        if path.is_dir():
            raise CpunetError(f"{path}: is a folder; give a file of pulses")
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise CpunetError(f"{path}: no such file; check the name") from None
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror}); check it") from error
    if not head:
        raise CpunetError(f"{path}: is empty; copy or write it again")
    # the FCIO library unpacks these two itself, by their suffix
    if path.name.endswith((".fcio.gz", ".fcio.zst")):
        return "FlashCam"
    for name, start in _FORMATS.items():
        if re.match(start, head, re.DOTALL):
            return name
    for start, (program, remedy) in _FOREIGN.items():
        if re.match(start, head):
            raise CpunetError(f"{path}: is a {program} file, which is not read", remedy)
    raise CpunetError(
        f"{path}: of no known format; give LH5, HDF5, FlashCam .fcio, NumPy .npz or .npy, or "
        "pickled pulses"
    )
