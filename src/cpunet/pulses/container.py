"""A container for sets of pulses from any file or simulator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError

if TYPE_CHECKING:
    from pandas import DataFrame

FloatArray = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Which = slice | Flags | Rows  # of some pulses

BLOCK = 512  # pulses at a time, to bound memory

_PER_PULSE = ("waveforms", "energy_kev", "event_number", "peak", "t0_ns")


@dataclass(frozen=True, eq=False, repr=False)
class Pulses:
    """A set of pulses of equal length and sampling, with energy and event number.

    Parameters
    ----------
    waveforms
        Float32 array of shape ``(n, length)``, in ADC counts for raw traces and in units
        of the full charge for simulated and prepared pulses.
    dt_ns
        Sampling period in ns, the same for all pulses.
    energy_kev
        Energy of each pulse in keV; NaN where unknown.
    event_number
        Event number in the source.
    peak
        Name of the gamma line of each energy (``"FEP"``, …), ``""`` for none.
    t0_ns
        Time of the first sample of each pulse in ns, simulated ones after the deposit; 0 where
        a file does not say.

    Raises
    ------
    CpunetError
        If shapes disagree or the sampling period is not a positive number.

    Examples
    --------
    >>> import numpy as np
    >>> pulses = Pulses.of(np.zeros((3, 8)), dt_ns=16, energy_kev=[1592.5, 2103.5, 2614.5])
    >>> len(pulses), pulses.length
    (3, 8)
    >>> pulses[pulses.energy_kev > 2000].event_number
    array([1, 2])
    >>> pulses[:2]
    <2 pulses of 8 samples, 16 ns each, 1592 to 2104 keV>
    """

    waveforms: FloatArray
    dt_ns: float
    energy_kev: npt.NDArray[np.float64]
    event_number: npt.NDArray[np.int64]
    peak: npt.NDArray[np.str_]
    t0_ns: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.waveforms.ndim != 2:
            shape = self.waveforms.shape
            raise CpunetError(f"waveforms have shape {shape}; expected (pulses, samples)")
        n = len(self.waveforms)
        for name in _PER_PULSE[1:]:
            shape = getattr(self, name).shape
            if shape != (n,):
                raise CpunetError(f"{name} has shape {shape} for {n} waveforms")
        if not (np.isfinite(self.dt_ns) and self.dt_ns > 0):
            raise CpunetError(f"the sampling period is {self.dt_ns} ns; expected more than 0")

    @classmethod
    def of(
        cls,
        waveforms: npt.ArrayLike,
        *,
        dt_ns: float,
        energy_kev: npt.ArrayLike | None = None,
        event_number: npt.ArrayLike | None = None,
        peak: npt.ArrayLike | None = None,
        t0_ns: npt.ArrayLike = 0.0,
    ) -> Pulses:
        """Build a set from array-likes, with defaults for unknown quantities."""
        values = _numbers(waveforms, np.float32, "waveforms")
        n = len(values)
        kev = np.full(n, np.nan) if energy_kev is None else energy_kev
        numbers = np.asarray(np.arange(n) if event_number is None else event_number, np.int64)
        peaks = np.full(n, "") if peak is None else np.asarray(peak, np.str_)
        times = np.broadcast_to(np.asarray(t0_ns, float), (n,))
        energies = _numbers(kev, np.float64, "energy_kev")
        return cls(values, float(dt_ns), energies, numbers, peaks, times)

    def __len__(self) -> int:
        return len(self.waveforms)

    @property
    def length(self) -> int:
        """Samples per pulse."""
        return int(self.waveforms.shape[1])

    def __getitem__(self, which: Which) -> Pulses:
        """The pulses selected by a slice, a mask or row numbers."""
        chosen = {name: getattr(self, name)[which] for name in _PER_PULSE}
        return Pulses(dt_ns=self.dt_ns, **chosen)

    def __repr__(self) -> str:
        finite = self.energy_kev[np.isfinite(self.energy_kev)]
        kev = f", {finite.min():.0f} to {finite.max():.0f} keV" if len(finite) else ""
        return f"<{len(self)} pulses of {self.length} samples, {self.dt_ns:g} ns each{kev}>"

    def to_dataframe(self) -> DataFrame:
        """Event number, energy in keV and gamma line of each pulse, as a data frame."""
        from pandas import DataFrame

        return DataFrame({n: getattr(self, n) for n in ("event_number", "energy_kev", "peak")})

    def save(self, path: str | Path, *, force: bool = False) -> Path:
        """Write the pulses to an LH5 file.

        Raises
        ------
        CpunetError
            If the file exists, unless `force`.
        """
        from cpunet.pulses.writing import PulseWriter

        with PulseWriter(path, force=force) as writer:
            writer.append(self)
        return Path(path)

    def with_waveforms(self, waveforms: FloatArray) -> Pulses:
        """The same events with other waveforms."""
        return replace(self, waveforms=waveforms)

    @staticmethod
    def concatenate(sets: Sequence[Pulses]) -> Pulses:
        """Concatenate sets of equal length and sampling, at least one."""
        first = sets[0]
        for other in sets[1:]:
            if (other.length, other.dt_ns) != (first.length, first.dt_ns):
                both = [f"{of.length} samples of {of.dt_ns} ns" for of in (other, first)]
                raise CpunetError(f"cannot join {both[0]} to {both[1]}")
        joined = {n: np.concatenate([getattr(s, n) for s in sets]) for n in _PER_PULSE}
        return Pulses(dt_ns=first.dt_ns, **joined)


def _numbers(values: npt.ArrayLike, kind: type[np.floating[Any]], name: str) -> Any:
    """Plain numbers of anything like an array; what is masked, which NumPy drops, is NaN."""
    try:
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(kind), np.nan)
        return np.asarray(values, kind)
    except (ValueError, TypeError) as error:  # of awkward as of NumPy
        remedy = "give rows of equal length, and NaN for what is missing"
        why = str(error).splitlines()[0][:100]
        raise CpunetError(f"{name}: no plain numbers ({why})", remedy) from error


def blocks(n: int, size: int = BLOCK) -> Iterator[slice]:
    """Slices of `size` rows that cover `n` pulses."""
    return (slice(first, first + size) for first in range(0, n, size))


def line_slope(n: int) -> npt.NDArray[np.float64]:
    """Weights of `n` equally spaced values that give the slope of a straight line per sample.

    Examples
    --------
    >>> float(line_slope(5) @ np.array([3.0, 5.0, 7.0, 9.0, 11.0]))
    2.0
    """
    lever = np.arange(n) - (n - 1) / 2
    return np.asarray(lever / (lever @ lever))


def shortest(ordered: npt.NDArray[np.float64], n: int) -> npt.NDArray[np.float64]:
    """The `n` neighbours among sorted values that lie closest together.

    Examples
    --------
    >>> shortest(np.array([0.0, 1.0, 5.0, 5.1, 5.2, 9.0]), 3)
    array([5. , 5.1, 5.2])
    """
    first = int((ordered[n - 1 :] - ordered[: len(ordered) - n + 1]).argmin())
    return ordered[first : first + n]
