"""Translate libraries of ideal charge pulses to current libraries, as LEGEND reads them.

The layout is that of LEGEND's production (legend-simflow): per detector a ``struct{r, z, dt,
t0, waveform_000_deg, drift_time_000_deg, ...}`` of currents in units of the most frequent A/E.

A template is the charge pulse of one position in the detector.  Users of the library sum
templates weighted by energy.  Templates must therefore not be aligned or normalised, unlike in
`Translator.translate`: a readout chain acts directly on the template.
"""

from __future__ import annotations

import copy
import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy.ndimage import binary_fill_holes

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.legend.currents import (
    LENGTH,
    PEAK,
    RINGS,
    Floats,
    Values,
    continued,
    currents_about_peak,
    most_frequent,
    padded_axis,
    with_rings,
)
from cpunet.legend.library_files import (
    PERIOD_NS,
    IdealLibrary,
    chosen_libraries,
    describe,
    known_detector,
    put,
    require_complete,
)
from cpunet.networks.response_layer import padding
from cpunet.outputs import refuse_existing
from cpunet.progress import stage
from cpunet.pulses.container import FloatArray, blocks
from cpunet.pulses.writing import written_hdf5
from cpunet.training.run import RunLike, used_run
from cpunet.translation.backends import ResponseBackend
from cpunet.translation.translator import BATCH, REN

log = logging.getLogger(__name__)


class TemplateTranslator:
    """Translates templates without noise; sample k of the result is at the time of sample k.

    A readout chain responds to a template of any height.  Its poles and decays are times, so
    the sampling period can differ from that of the training.

    Parameters
    ----------
    ren
        Trained run.
    dt_ns
        Sampling period of the templates in ns.

    Raises
    ------
    CpunetError
        If the run has a network, which translates prepared pulses alone.
    """

    def __init__(self, ren: REN, dt_ns: float) -> None:
        if not isinstance(ren.backend, ResponseBackend):
            raise CpunetError(
                "the run's network translates whole pulses, not the templates that they are "
                "summed from; give a run of the recipe fast"
            )
        if ren.backend.by_height is not None:
            log.warning(
                "templates are summed, and get the linear part of the readout alone: its slew "
                "rate and curve act on the sums"
            )
        self._chain = copy.deepcopy(ren.backend.network)
        self._chain.response.dt_ns[...] = dt_ns
        if self._chain.response.drift is not None:
            self._chain.response.drift.keeps_begin = True  # templates are summed by time

    def __call__(self, templates: FloatArray) -> FloatArray:
        """Translate templates of charge, 0 before it moves, shape (n, samples)."""
        results = np.empty(templates.shape, np.float32)
        before = padding(float(self._chain.response.dt_ns))[0]
        inside = slice(before, before + templates.shape[1])
        for rows in blocks(len(templates), BATCH):
            results[rows] = self._chain(templates[rows].astype(np.float32))[:, inside]
        return results


ROWS = 16  # rows of r read at a time
MIN_END = 0.5  # of the maximum; templates of charge end near it, those of current do not
STEP_SAMPLE, STEP_LENGTH = 500, 3000  # of a charge step to measure the delay


@dataclass(frozen=True)
class LibraryNumbers:
    """What was counted and measured of a translated library.

    Attributes
    ----------
    templates, translated
        Grid points times angles, and those with a template.
    padded, healed
        Filled grid points, and those of them inside the crystal.
    mode_per_ns
        A/E by which currents are divided.
    delay_ns
        Time that is subtracted from drift times.
    """

    templates: int
    translated: int
    padded: int
    healed: int
    mode_per_ns: float
    delay_ns: float

    def __str__(self) -> str:
        healed = f", {self.healed} of them within it" if self.healed else ""
        return (
            f"{self.translated} of {self.templates} templates translated, {self.padded} added "
            f"about the crystal{healed}; A/E is most often {self.mode_per_ns:.4g}/ns"
        )


@dataclass(frozen=True)
class TranslatedLibrary:
    """A library that was translated.

    Parameters
    ----------
    path
        The file.
    numbers
        What was counted, by name of the library.
    """

    path: Path
    numbers: dict[str, LibraryNumbers]

    def __str__(self) -> str:
        return "\n".join(f"{self.path}: {name}: {of}" for name, of in self.numbers.items())


def translate_library(
    run: RunLike,
    library: str | Path,
    out: str | Path,
    *,
    detector: Sequence[str] = (),
    force: bool = False,
) -> TranslatedLibrary:
    """Translate every template of a library without noise, to currents for LEGEND's production.

    A library is an LH5 ``struct{r, z, dt, t0, waveform_000_deg, ...}`` with templates of
    charge in arrays of shape (r, z, samples), as SolidStateDetectors.jl and
    `cpunet.make_library` make them; a file may hold several, at any depth.  The currents of
    one are in memory: 16 kB for each template.

    Each template is translated, differentiated, averaged three times over 48 ns and shifted so
    that its maximum is at sample 1,000 of 4,001.  All are divided by the mode of A/E of the
    library and written as float32.  ``drift_time_*_deg`` are the times of the maxima minus
    that of a step of charge at time 0.  The grid is padded around the crystal: currents there
    are means of their neighbours, and drift times are extrapolated linearly.

    Parameters
    ----------
    run
        A trained run with a readout chain, or its folder.
    library
        LH5 file of libraries.
    out
        LH5 file to write.
    detector
        Library of the file to translate (repeatable); by default that of the detector that
        the run was trained with, or all if it is unknown.
    force
        Replace an existing file.

    Returns
    -------
    TranslatedLibrary
        The file, with what was counted.

    Raises
    ------
    CpunetError
        If the file contains no library of charge templates, it is damaged, of another
        detector or sampling period, or the run has a network.

    Examples
    --------
    cpunet library translate run psl.lh5 --out psl_ren.lh5
    """
    run, source, out = used_run(run), Path(library), Path(out)
    refuse_existing(out, run.folder, source, force=force)
    translate = TemplateTranslator(REN.of(run), PERIOD_NS)
    numbers: dict[str, LibraryNumbers] = {}
    with opened(source) as given:
        names = chosen_libraries(given, source, detector, known_detector(run))
        ideal = [IdealLibrary.of(given, name, source) for name in names]
        made_from = {"run": run.name, "weights": run.weights_sha256, "ideal": str(source)}
        with written_hdf5(out) as (made, _):
            for charge in ideal:
                group = made.require_group(charge.path)
                counted = _write(translate, charge, given[charge.path], group)
                content = {"cpunet": cpunet.__version__, "rings": RINGS, **made_from}
                group.attrs["cpunet"] = json.dumps(content | asdict(counted))
                describe(group)
                numbers[charge.path] = counted
    return TranslatedLibrary(out, numbers)


def _write(
    translate: TemplateTranslator,
    library: IdealLibrary,
    given: h5py.Group,
    group: h5py.Group,
) -> LibraryNumbers:
    """Write currents, and drift times within the crystal and about it."""
    step = np.zeros((1, STEP_LENGTH), np.float32)
    step[:, STEP_SAMPLE:] = 1
    delay_ns = float(currents_about_peak(translate(step))[1][0]) - STEP_SAMPLE
    r_mm = padded_axis(library.r_mm, 0, RINGS)  # none at negative radii
    z_mm = padded_axis(library.z_mm, RINGS, RINGS)
    shape, inner = (len(r_mm), len(z_mm)), np.s_[: len(library.r_mm), RINGS : len(z_mm) - RINGS]
    currents, times = dict[str, Floats](), dict[str, Values]()
    not_ending = 0
    with stage(f"Translating {library.path}", library.n_templates) as bar:
        for angle in library.angles:
            currents[angle] = np.full((*shape, LENGTH), np.nan, np.float32)
            times[angle] = np.full(shape, np.nan)
            within = currents[angle][inner], times[angle][inner]
            for rows, charge in _blocks(given[f"waveform_{angle}"], library):
                held = ~np.isnan(charge[:, :, 0])
                templates = charge[held]
                within[0][rows][held], when = currents_about_peak(translate(templates))
                within[1][rows][held] = when - delay_ns
                ends, heights = templates[:, -1], np.abs(templates).max(axis=1)
                not_ending += int((np.isfinite(when) & (ends < MIN_END * heights)).sum())
                bar.update(held.size)
    inside = {angle: np.isfinite(when[inner]) for angle, when in times.items()}
    translated = sum(int(mask.sum()) for mask in inside.values())
    if not translated:
        raise CpunetError(
            f"{library.where}: none of {library.n_templates} templates can be translated; are "
            "they charge pulses?"
        )
    if 2 * not_ending > translated:
        raise CpunetError(
            f"{library.where}: {not_ending} of {translated} templates end below half of their "
            "maximum: these are currents, of negative sign, or behind electronics already; "
            "give the library of charge pulses"
        )
    require_complete(inside, library)
    amplitudes = [currents[a][inner][mask, PEAK] for a, mask in inside.items()]
    mode = most_frequent(np.concatenate(amplitudes).astype(float))

    put(group, "r", r_mm, "mm")
    put(group, "z", z_mm, "mm")
    put(group, "dt", PERIOD_NS, "ns")
    put(group, "t0", -PEAK * PERIOD_NS, "ns")
    padded = healed = 0
    for angle, mask in inside.items():
        currents[angle] /= np.float32(mode)
        put(group, f"waveform_{angle}", with_rings(currents.pop(angle)), "")
        filled = continued(times[angle])
        put(group, f"drift_time_{angle}", filled.astype(np.float32), "ns")
        padded += int(np.isfinite(filled).sum() - mask.sum())
        healed += int((np.isfinite(filled[inner]) & ~mask & binary_fill_holes(mask)).sum())
    return LibraryNumbers(library.n_templates, translated, padded, healed, mode, delay_ns)


def _blocks(given: h5py.Dataset, library: IdealLibrary) -> Iterator[tuple[slice, Floats]]:
    """Rows of charge templates, NaN for those of only zeros.

    Raises
    ------
    CpunetError
        If only a part of a template is NaN.
    """
    for first in range(0, given.shape[0], ROWS):
        charge = np.array(given[first : first + ROWS], np.float32)
        bad = np.isnan(charge)
        part = bad.any(axis=2) & ~bad.all(axis=2)
        if part.any():
            i, j = np.argwhere(part)[0]
            raise CpunetError(
                f"{library.where}: {int(part.sum())} templates hold NaN among their samples, "
                f"the first at r {library.r_mm[first + i]:g}, z {library.z_mm[j]:g} mm of "
                f"{given.name}; simulate the library again, with longer records if "
                "charge was late"
            )
        charge[~charge.any(axis=2)] = np.nan
        yield slice(first, first + len(charge)), charge
