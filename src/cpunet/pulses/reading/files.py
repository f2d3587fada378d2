"""A file of pulses and how it is read, or pulses in memory in its place."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses

if TYPE_CHECKING:
    from cpunet.pulses.reading.source import PulseSource


_TOLD = ("table", "energy", "kev_per_adc", "dt_ns")  # what a run keeps


@dataclass(frozen=True)
class FileOptions:
    """How a file of pulses is read, if it does not tell itself.

    Parameters
    ----------
    table
        Table of the pulses, if the file has several; ``all``: each for itself.
    energy
        Energy column, or ``FILE:path/to/column``, as of a hit tier.
    kev_per_adc
        Calibration of pulses without energies in keV: keV per ADC count.
    dt_ns
        Sampling period in ns.
    insist
        Pulses are simulated or measured as given, whatever they look like.
    """

    table: str | None = None
    energy: str | None = None
    kev_per_adc: float | None = None
    dt_ns: float | None = None
    insist: bool = False


@dataclass(frozen=True)
class ReadOptions:
    """How the files of both sides are read, if they do not tell themselves.

    Parameters
    ----------
    data_table
        Table of the measured pulses, if the file has several; ``all``: each for itself.
    data_energy
        Energy column of the data, or ``FILE:path/to/column``, as of a hit tier.
    kev_per_adc
        Calibration of measured pulses without energies in keV: keV per ADC count.
    dt_ns
        Sampling period in ns.
    sim_table
        Table of the simulated pulses, if the file has several.
    insist
        Pulses are simulated or measured as given, whatever they look like.
    """

    data_table: str | None = None
    data_energy: str | None = None
    kev_per_adc: float | None = None
    dt_ns: float | None = None
    sim_table: str | None = None
    insist: bool = False

    @property
    def sim(self) -> FileOptions:
        """Those of the simulated pulses, which are in keV."""
        return FileOptions(self.sim_table, None, None, self.dt_ns, self.insist)

    @property
    def data(self) -> FileOptions:
        """Those of the measured pulses."""
        return FileOptions(
            self.data_table, self.data_energy, self.kev_per_adc, self.dt_ns, self.insist
        )


@dataclass(frozen=True)
class PulseFile:
    """A file of pulses and how it is read; see `cpunet.open_pulses`.

    Parameters
    ----------
    path
        The file.
    table, energy, kev_per_adc, dt_ns, insist
        As of `FileOptions`.
    pulses
        Pulses in memory, which are read in place of a file.
    """

    path: Path
    table: str | None = None
    energy: str | None = None
    kev_per_adc: float | None = None
    dt_ns: float | None = None
    insist: bool = False
    pulses: Pulses | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))  # users may give text
        for name in ("kev_per_adc", "dt_ns"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise CpunetError(f"{self.path}: {name} is {value}; expected more than 0")

    @property
    def files(self) -> tuple[Path | str | None, ...]:
        """Paths that are read, for `cpunet.outputs.refuse_inputs`."""
        return () if self.pulses is not None else (self.path, self.energy)

    @property
    def options(self) -> dict[str, Any]:
        """The reading options given by the user."""
        given = {name: getattr(self, name) for name in _TOLD}
        return {name: value for name, value in given.items() if value is not None}

    def open(self) -> PulseSource:
        """Open the file."""
        from cpunet.pulses.reading.opening import open_file

        return open_file(self)


Source: TypeAlias = str | Path | PulseFile | Pulses


def pulse_file(source: Source, options: FileOptions = FileOptions()) -> PulseFile:
    """A file of pulses from what a user gives: a path, a `PulseFile`, or `Pulses` in memory.

    Raises
    ------
    CpunetError
        If it is none of these, or options are given for what has its own.
    """
    if isinstance(source, str | Path):
        return PulseFile(Path(source), **asdict(options))
    given = ", ".join(name for name, value in asdict(options).items() if value)
    if given and isinstance(source, PulseFile | Pulses):
        raise CpunetError(
            f"{given}: is an option of a path", "give it to the PulseFile, or leave it out"
        )
    if isinstance(source, PulseFile):
        return source
    if isinstance(source, Pulses):
        return PulseFile(Path("pulses in memory"), pulses=source)
    raise CpunetError(
        f"{type(source).__name__}: are no pulses",
        "give a path, a cpunet.PulseFile, or cpunet.Pulses.of(array, dt_ns=…, energy_kev=…)",
    )
