"""`cpunet.translate`, and the translated pulses that it returns."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import hist
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from cpunet.errors import CpunetError
from cpunet.html_pages import notebook_picture, part
from cpunet.jobs.translation.translate import FileTranslation
from cpunet.jobs.translation.translate_options import Adc, TranslateOptions
from cpunet.plotting import COLOURS, styled
from cpunet.progress import stage
from cpunet.pulses.binning import MAX_BINS, data_axis, labelled
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Codes, Rejection
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.reading.files import PulseFile, Source, pulse_file
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.recipes.schema import Recipe
from cpunet.training.run import RunLike
from cpunet.translation.learned_remains import NONE
from cpunet.translation.output_form import Formed

log = logging.getLogger(__name__)

DRAWN = 50  # pulses in a figure


@dataclass(frozen=True, eq=False, repr=False)
class Translation:
    """Translated pulses, in the order of the input.

    Parameters
    ----------
    run
        The run that translated them, its folder.
    counts
        Row counts: ``read``, ``translated``, ``rejections`` by reason; ``saturated`` in ADC.
    recipe
        Recipe of the run.
    adc
        Whether the pulses are raw traces in ADC counts instead of normalised windows.
    path
        The file they were written to; None if they are in memory only.
    kept
        The pulses and the codes of their rejections if they are in memory.
    """

    run: str
    counts: Mapping[str, Any]
    recipe: Recipe
    adc: bool = False
    path: Path | None = None
    kept: tuple[Pulses, Codes] | None = None

    @cached_property
    def pulses(self) -> Pulses:
        """All pulses; those in a file are read on first access."""
        return self.kept[0] if self.kept else open_pulses(self._file()).read()

    @cached_property
    def codes(self) -> Codes:
        """`cpunet.pulses.preparation.Rejection` code of each row; 0 for a translated pulse."""
        if self.kept:
            return self.kept[1]
        column = open_pulses(self._file()).columns["rejection"]
        return np.asarray(column.read(0, len(column)), np.uint8)

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Which rows hold a pulse, shape (n,)."""
        return np.asarray(self.codes == Rejection.ACCEPTED)

    @property
    def rejections(self) -> dict[str, int]:
        """Number of rows without a pulse, by reason."""
        return dict(self.counts["rejections"])

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

    def hist(
        self, parameter: str = "current_amplitude", max_bins: int = MAX_BINS
    ) -> hist.Hist[Any]:
        """Distribution of a parameter as a `hist.Hist`.

        Raises
        ------
        CpunetError
            If there is no such parameter.
        """
        values = named(self.parameters, parameter, "parameter")
        axis = labelled(data_axis(values, max_bins), parameter)
        made: hist.Hist[Any] = hist.Hist(axis)
        return made.fill(values[np.isfinite(values)])

    @styled
    def figure(self, n: int = DRAWN) -> Figure:
        """Draw the first `n` translated pulses over each other."""
        rows = np.flatnonzero(self.valid)[:n]
        figure = Figure(figsize=(6.4, 3.2))
        axes = figure.subplots()
        pulses = self.pulses
        time_us = np.arange(pulses.length) * pulses.dt_ns * 1e-3
        lines = pulses.waveforms[rows].T
        axes.plot(time_us, lines, color=COLOURS["ren"], lw=0.6, alpha=0.5)
        axes.set_xlabel("Time [µs]")
        axes.set_ylabel("ADC counts" if self.adc else "Pulse height")
        axes.set_title(f"{len(rows)} of {self.counts['translated']} translated pulses")
        return figure

    def _file(self) -> Path:
        if self.path is None:
            raise CpunetError(
                "these pulses are neither in memory nor in a file; translate them again"
            )
        return self.path

    def __repr__(self) -> str:
        where = "in memory" if self.path is None else str(self.path)
        done = f"{self.counts['translated']} of {self.counts['read']} pulses"
        return f"<Translation {where}: {done}>"

    def _repr_html_(self) -> str:
        told: dict[str, object] = {
            "run": self.run,
            "file": self.path,
            "translated": f"{self.counts['translated']} of {self.counts['read']} pulses",
            "as": "raw traces in ADC" if self.adc else "normalised windows",
            "saturated": self.counts.get("saturated"),
        }
        told |= {reason.replace("_", " "): n for reason, n in self.rejections.items()}
        small = self.kept is not None  # a file may be large
        drawn = notebook_picture(self.figure()) if small and self.counts["translated"] else ""
        return part("object", "cpunet translation", told, picture=drawn)


def translate(
    run: RunLike,
    pulses: Source,
    out: str | Path | None = None,
    *,
    inverse: bool = False,
    noise: bool = True,
    seed: int = 0,
    adc: Adc | bool = False,
    remains: str = NONE,
    pile_up_khz: float = 0.0,
    realisations: int | None = None,
    device: str = "auto",
    resume: bool = False,
    force: bool = False,
) -> Translation:
    """Make simulated pulses look measured, or with `inverse` the other way round.

    Parameters
    ----------
    run
        A trained run or its folder.
    pulses
        A file, which is streamed if `out` is given; or pulses in memory.
    out
        LH5 file to write, with all columns of the source; None to stay in memory.
    inverse
        Whether to translate measured to simulation-like pulses.
    noise, seed
        Whether to add noise, and its seed.  The noise is the same in memory and in a file.
    adc
        Whether to make raw traces in ADC counts, like those of a digitiser; or `Adc` with its
        settings.
    remains
        Remains of earlier pulses: ``"learned"``, ``"none"``, or a rate in kHz.
    pile_up_khz
        Rate in kHz of second pulses within a trace.
    realisations
        Number of noise draws for each pulse.
    device
        ``"cpu"``, ``"cuda"`` or ``"auto"``.
    resume
        Whether to keep an existing file that was made from this input, run and options.
    force
        Whether to replace an existing file.

    Returns
    -------
    Translation
        The translated pulses.

    Raises
    ------
    CpunetError
        If an argument cannot be used, or no pulse can be translated.
    """
    wanted = (Adc() if adc else None) if isinstance(adc, bool) else adc
    options = TranslateOptions(
        inverse,
        noise,
        seed,
        realisations=realisations,
        adc=wanted,
        remains=remains,
        pile_up_khz=pile_up_khz,
    )
    job = FileTranslation(run, options, device)
    for doubt in job.doubts:
        log.warning(doubt)
    made = Translation(job.run.name, {}, job.run.recipe, adc=wanted is not None)
    if isinstance(pulses, Pulses):
        if out is not None:
            raise CpunetError(
                f"{out}: pulses in memory stay there; leave out the file, or write them with "
                "cpunet.pulses.writing.write_pulses and give that file"
            )
        return _in_memory(job, made, pulses)
    source = pulse_file(pulses)
    if out is None:
        return _in_memory(job, made, source)
    counts = job(source, Path(out), resume=resume, force=force)
    return replace(made, counts=counts, path=Path(out))


def _in_memory(
    job: FileTranslation, made: Translation, given: Pulses | PulseFile
) -> Translation:
    pulses = given if isinstance(given, Pulses) else job.opened(given).read()
    if not len(pulses):
        raise CpunetError("there are no pulses to translate; give some")
    formed: list[Formed] = []
    with stage("Translating", len(pulses)) as bar:
        for block in job.blocks([pulses]):
            formed.append(block)
            bar.update(len(block.codes) // (job.options.realisations or 1))
    codes = np.concatenate([block.codes for block in formed])
    accepted = int((codes == Rejection.ACCEPTED).sum())
    reasons = Counter(Rejection(int(code)).label for code in codes if code)
    if not accepted:
        told = ", ".join(f"{n} {reason}" for reason, n in reasons.items())
        raise CpunetError(
            f"none of {len(pulses)} pulses can be translated ({told}); are these "
            f"{job.translator.takes} pulses, with energies in keV?"
        )
    counts: dict[str, Any] = {
        "read": len(codes),
        "translated": accepted,
        "rejections": dict(reasons),
    }
    if made.adc:
        counts["saturated"] = int(sum(block.saturated.sum() for block in formed))
    whole = Pulses.concatenate([block.pulses for block in formed])
    return replace(made, counts=counts, kept=(whole, codes))


def named(values: Mapping[str, Any], name: str, kind: str) -> Any:
    """A value by name.

    Raises
    ------
    CpunetError
        If there is no such value; the message lists the known names.
    """
    if name not in values:
        raise CpunetError(f"no {kind} {name!r}; there are {', '.join(values)}")
    return values[name]
