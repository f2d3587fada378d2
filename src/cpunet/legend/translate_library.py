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
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import binary_fill_holes

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.legend.currents import (
    LENGTH,
    PEAK,
    RINGS,
    Floats,
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
    put_array,
    put_column,
    require_complete,
)
from cpunet.networks.response_layer import PADDING_BEFORE
from cpunet.outputs import refuse_existing
from cpunet.progress import Stage, stage
from cpunet.pulses.container import FloatArray
from cpunet.pulses.writing import written_hdf5
from cpunet.training.run import RunLike, as_run, resolve_device
from cpunet.translation.translator import BATCH, REN


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
        if ren.backend.chain is None or ren.recipe.generator.name == "learned":
            raise CpunetError(
                "the run's network translates whole pulses, not the templates that they are "
                "summed from; give a run of the recipe fast"
            )
        self._device = ren.backend.device
        self._chain = copy.deepcopy(ren.backend.chain)
        self._chain.response.dt_ns.fill_(dt_ns)
        if self._chain.response.drift is not None:
            self._chain.response.drift.keeps_begin = True  # templates are summed by time

    def __call__(self, templates: FloatArray) -> FloatArray:
        """Translate templates of charge, 0 before it moves, shape (n, samples)."""
        results = np.empty(templates.shape, np.float32)
        inside = slice(PADDING_BEFORE, PADDING_BEFORE + templates.shape[1])
        with torch.inference_mode():
            for first in range(0, len(templates), BATCH):
                rows = slice(first, first + BATCH)
                charge = torch.from_numpy(np.ascontiguousarray(templates[rows], np.float32))
                records = self._chain(charge.to(self._device))
                results[rows] = records[:, inside].cpu().numpy()
        return results


ROWS = 16  # rows of r translated at a time
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
        return "\n".join(f"{self.path}: {name}: {one}" for name, one in self.numbers.items())


def translate_library(
    run: RunLike,
    library: str | Path,
    out: str | Path,
    *,
    detector: Sequence[str] = (),
    rings: int = RINGS,
    force: bool = False,
) -> TranslatedLibrary:
    """Translate every template of a library without noise, to currents for LEGEND's production.

    A library is an LH5 ``struct{r, z, dt, t0, waveform_000_deg, ...}`` with templates of
    charge in arrays of shape (r, z, samples), as SolidStateDetectors.jl and
    `cpunet.make_library` make them; a file may hold several, at any depth.  Files are
    streamed.

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
        LH5 file of one library or more.
    out
        LH5 file to write.
    detector
        Library of the file to translate (repeatable); by default that of the detector that
        the run was trained with, or all if it is unknown.
    rings
        Rings of nodes beyond the crystal; 3 as production.
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
    if not 0 <= rings <= 100:
        raise CpunetError(f"`rings` {rings}: give 0 to 100 rings of padding")
    run, source, out = as_run(run), Path(library), Path(out)
    refuse_existing(out, run.folder, source, force=force)
    translate = TemplateTranslator(REN.of(run, resolve_device("auto")), PERIOD_NS)
    numbers: dict[str, LibraryNumbers] = {}
    with opened(source) as given:
        names = chosen_libraries(given, source, detector, known_detector(run))
        ideal = [IdealLibrary.of(given, name, source) for name in names]
        made_from = {"run": run.name, "weights": run.weights_sha256, "ideal": str(source)}
        with written_hdf5(out) as (made, _):
            for one in ideal:
                looked = _look(translate, one, given[one.path], source)
                group = made.require_group(one.path)
                found = looked.write(given[one.path], group, rings)
                content = {"cpunet": cpunet.__version__, "rings": rings, **made_from}
                group.attrs["cpunet"] = json.dumps(content | asdict(found))
                describe(group)
                numbers[one.path] = found
    return TranslatedLibrary(out, numbers)


@dataclass(frozen=True, eq=False)
class _Looked:
    """Results of a first pass over all templates of a library, which a second pass writes."""

    translate: TemplateTranslator
    library: IdealLibrary
    delay_ns: float
    mode: float
    inside: dict[str, npt.NDArray[np.bool_]]

    def write(self, given: h5py.Group, group: h5py.Group, rings: int) -> LibraryNumbers:
        """Write currents, and drift times within the crystal and beside it."""
        library = self.library
        r_mm = padded_axis(library.r_mm, 0, rings)  # none at negative radii
        z_mm = padded_axis(library.z_mm, rings, rings)
        put_column(group, "r", r_mm, "mm")
        put_column(group, "z", z_mm, "mm")
        put_column(group, "dt", PERIOD_NS, "ns")
        put_column(group, "t0", -PEAK * PERIOD_NS, "ns")
        padded = healed = 0
        shape = (len(r_mm), len(z_mm))
        for angle, mask in self.inside.items():
            values = put_array(group, f"waveform_{angle}", (*shape, LENGTH), np.float32, "")
            drift_times = put_array(group, f"drift_time_{angle}", shape, np.float32, "ns")
            times = np.full(shape, np.nan)
            with stage(f"{library.path}, {angle}", len(r_mm)) as bar:
                for rows, currents, when in self._rows(given[f"waveform_{angle}"], rings, bar):
                    values[rows], times[rows] = currents, when
            times = continued(times, rings)
            drift_times[...] = times
            padded += int(np.isfinite(times).sum() - mask.sum())
            inner = np.isfinite(times[: len(mask), rings:][:, : mask.shape[1]])
            healed += int((inner & ~mask & binary_fill_holes(mask)).sum())
        return LibraryNumbers(
            templates=library.n_templates,
            translated=sum(int(mask.sum()) for mask in self.inside.values()),
            padded=padded,
            healed=healed,
            mode_per_ns=self.mode,
            delay_ns=self.delay_ns,
        )

    def _rows(
        self, given: h5py.Dataset, rings: int, bar: Stage
    ) -> Iterator[tuple[slice, Floats, npt.NDArray[np.float64]]]:
        """Rows of the padded grid: normalised currents, and drift times within the crystal."""
        n_r, n_z, _ = given.shape
        for first in range(0, n_r + rings, ROWS):
            last = min(first + ROWS, n_r + rings)
            # a padded grid point depends only on rows at most `rings` away
            low, high = max(0, first - rings), min(last + rings, n_r)
            shape = (last + rings - low, n_z + 2 * rings)
            currents = np.full((*shape, LENGTH), np.nan, np.float32)
            times = np.full(shape, np.nan)
            if high > low:
                charge = _charge(given[low:high])
                there = ~np.isnan(charge[:, :, 0])
                of_these, when = currents_about_peak(self.translate(charge[there]))
                inner = (slice(0, high - low), slice(rings, rings + n_z))
                currents[inner][there] = of_these / np.float32(self.mode)
                times[inner][there] = when - self.delay_ns
            own = slice(first - low, last - low)
            yield slice(first, last), with_rings(currents, rings)[own], times[own]
            bar.update(last - first)


def _look(
    translate: TemplateTranslator, library: IdealLibrary, given: h5py.Group, source: Path
) -> _Looked:
    """First pass over all templates, to find the mode of A/E before any is written."""
    step = np.zeros((1, STEP_LENGTH), np.float32)
    step[:, STEP_SAMPLE:] = 1
    _, delay = currents_about_peak(translate(step))
    amplitudes, inside = [], {}
    moving = not_ending = 0
    with stage(f"A/E of {library.path}", library.n_templates) as bar:
        for angle in library.angles:
            masks = []
            for block in _blocks(given[f"waveform_{angle}"], library, source):
                there = ~np.isnan(block[:, :, 0])
                templates = block[there]
                currents, times = currents_about_peak(translate(templates))
                good = np.isfinite(times)
                there[there] = good
                masks.append(there)
                moving += int(good.sum())
                ends, heights = templates[good, -1], np.abs(templates[good]).max(axis=1)
                not_ending += int((ends < MIN_END * heights).sum())
                amplitudes.append(currents[good, PEAK].astype(float))
                bar.update(block.shape[0] * block.shape[1])
            inside[angle] = np.concatenate(masks)
    if not moving:
        raise CpunetError(
            f"{source}: {library.path}: none of {library.n_templates} templates can be "
            "translated; are they charge pulses?"
        )
    if 2 * not_ending > moving:
        raise CpunetError(
            f"{source}: {library.path}: {not_ending} of {moving} templates end below half of "
            "their maximum: these are currents, of negative sign, or behind electronics "
            "already; give the library of charge pulses"
        )
    require_complete(inside, library, source)
    mode = most_frequent(np.concatenate(amplitudes))
    return _Looked(translate, library, float(delay[0]) - STEP_SAMPLE, mode, inside)


def _blocks(given: h5py.Dataset, library: IdealLibrary, source: Path) -> Iterator[Floats]:
    """Rows of charge templates; raise an error if only a part of a template is NaN."""
    for first in range(0, given.shape[0], ROWS):
        values = np.asarray(given[first : first + ROWS], np.float32)
        bad = np.isnan(values)
        part = bad.any(axis=2) & ~bad.all(axis=2)
        if part.any():
            i, j = np.argwhere(part)[0]
            raise CpunetError(
                f"{source}: {given.name}: {int(part.sum())} templates hold NaN among their "
                f"samples, the first at r {library.r_mm[first + i]:g}, z "
                f"{library.z_mm[j]:g} mm; simulate the library again, with longer records if "
                "charge was late"
            )
        yield _charge(values)


def _charge(values: npt.NDArray[Any]) -> Floats:
    """Templates as float32; those of only zeros become NaN."""
    charge = np.array(values, np.float32)
    charge[~charge.any(axis=2)] = np.nan
    return charge
