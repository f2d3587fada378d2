"""Translated pulses, in memory or in a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError, named
from cpunet.plotting import COLOURS, own_axes, styled
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Codes, Rejection
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.shape_parameters import (
    MAX_BINS,
    Histogram,
    all_parameters,
    data_axis,
    labelled,
)
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes.schema import Recipe
from cpunet.translation.translator import TranslatedPulses

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

DRAWN = 50  # pulses in a figure


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

    def __add__(self, other: Counts) -> Counts:
        names = ("read", "translated", "saturated", "skipped")
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        rejections = Counter(self.rejections) + Counter(other.rejections)
        return Counts(**sums, rejections=dict(rejections))


@dataclass(frozen=True, eq=False, repr=False)
class Translation:
    """Translated pulses, in the order of the input.

    Parameters
    ----------
    run
        Name of the run that translated them.
    recipe
        Recipe of the run.
    counts
        Numbers of rows read, translated and rejected, and of several files.
    adc
        Whether the pulses are raw traces in ADC counts instead of normalised windows.
    path
        The file they were written to, or a folder of several; None if they are in memory only.
    in_memory
        The pulses if they are in memory.
    writer
        Opens a file for those in memory.
    """

    run: str
    recipe: Recipe
    counts: Counts
    adc: bool
    path: Path | None = None
    in_memory: TranslatedPulses | None = None
    writer: Callable[..., PulseWriter] | None = None

    @cached_property
    def pulses(self) -> Pulses:
        """All pulses; those in a file are read on first access."""
        if self.in_memory:
            return self.in_memory.pulses
        assert self.path is not None
        return open_pulses(self.path).read()

    @cached_property
    def codes(self) -> Codes:
        """`cpunet.pulses.preparation.Rejection` code of each row; 0 for a translated pulse."""
        if self.in_memory:
            return self.in_memory.codes
        assert self.path is not None
        column = open_pulses(self.path).columns["rejection"]
        return np.asarray(column.values, np.uint8)

    @property
    def waveforms(self) -> FloatArray:
        """Translated waveforms, shape (n, samples); NaN, or 0 in ADC, in rejected rows."""
        return self.pulses.waveforms

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Which rows hold a pulse, shape (n,)."""
        return np.asarray(self.codes == Rejection.ACCEPTED)

    @property
    def rejections(self) -> dict[str, int]:
        """Number of rows without a pulse, by reason."""
        return dict(self.counts.rejections)

    @cached_property
    def parameters(self) -> dict[str, npt.NDArray[np.float64]]:
        """Pulse-shape parameters by name, shape (n,); see `SHAPE_PARAMETERS`.

        Raises
        ------
        CpunetError
            If these are raw traces, which must be prepared first.
        """
        if self.adc:
            raise CpunetError(
                f"{self.path or self.run}: raw traces in ADC have no parameters yet; run "
                "dspeed on them, or translate to windows"
            )
        return all_parameters(self.pulses, self.recipe.preparation, self.recipe.scores)

    def hist(self, parameter: str = "current_amplitude", bins: int | None = None) -> Histogram:
        """Distribution of a parameter as a `hist.Hist`, in so many bins if given.

        Raises
        ------
        CpunetError
            If there is no such parameter.
        """
        values = named(self.parameters, parameter, "parameter")
        histogram = Histogram(labelled(data_axis(values, MAX_BINS), parameter, bins))
        histogram.fill(values[np.isfinite(values)])
        return histogram

    @styled
    def plot(self, n: int = DRAWN, ax: Axes | None = None) -> Axes:
        """Draw the first `n` translated pulses over each other; return the axes.

        Parameters
        ----------
        n
            Number of pulses.
        ax
            Where to draw; a new figure of pyplot by default.
        """
        rows, axes = np.flatnonzero(self.valid)[:n], own_axes(ax)
        pulses = self.pulses
        time_us = np.arange(pulses.length) * pulses.dt_ns * 1e-3
        lines = pulses.waveforms[rows].T
        axes.plot(time_us, lines, color=COLOURS["ren"], lw=0.6, alpha=0.5)
        axes.set_xlabel("Time [µs]")
        axes.set_ylabel("ADC counts" if self.adc else "Normalised charge")
        axes.set_title(f"{len(rows)} of {self.counts.translated} translated pulses")
        return axes

    def to_dataframe(self) -> DataFrame:
        """Event, energy, reason of rejection and parameters of each pulse, as a data frame."""
        columns: dict[str, Any] = {
            "rejection": [Rejection(int(code)).label for code in self.codes]
        }
        columns |= {} if self.adc else self.parameters
        return self.pulses.to_dataframe().assign(**columns)

    def save(self, path: str | Path, *, force: bool = False) -> Path:
        """Write pulses that are in memory to an LH5 file, without other columns of the source.

        Raises
        ------
        CpunetError
            If they are in a file, or the file exists (without `force`) or cannot be written.
        """
        if self.in_memory is None or self.writer is None:
            raise CpunetError(f"{self.path}: holds these pulses already; copy it")
        with self.writer(Path(path), force=force) as writer:
            done = self.in_memory
            writer.append(done.pulses, {"rejection": (done.codes, ""), **done.truth})
        return Path(path)

    def __len__(self) -> int:
        return self.counts.read

    def __str__(self) -> str:
        counts = self.counts
        text = f"{counts.translated} of {counts.read} pulses translated"
        if counts.files:
            text = f"{counts.files} files, {text}"
        if counts.skipped:
            which = f"{counts.skipped} files were" if counts.files else "it was"
            text += f" ({which} there already)"
        if rejected := ", ".join(f"{n} {reason}" for reason, n in self.rejections.items()):
            text += f"; rows of {'0' if self.adc else 'NaN'} for {rejected}"
        if counts.saturated:
            text += f"; {counts.saturated} saturated"
        return f"{self.path or 'in memory'}: {text}"

    def __repr__(self) -> str:
        where = "in memory" if self.path is None else str(self.path)
        done = f"{self.counts.translated} of {self.counts.read} pulses"
        return f"<Translation {where}: {done}>"
