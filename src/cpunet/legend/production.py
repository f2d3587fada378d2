"""Translate libraries of ideal charge pulses to realistic ones of currents for reboost.

The layout is that of LEGEND's production (legend-simflow): per detector a ``struct{r, z, dt,
t0, waveform_000_deg, drift_time_000_deg, ...}`` of currents in units of the most frequent A/E.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.legend.ideal_library import (
    IdealLibrary,
    chosen_libraries,
    known_detector,
    require_complete,
)
from cpunet.legend.library_file import n_not_ending, require_charge
from cpunet.legend.low_rank import MAX_TEMPLATES, Loss, components
from cpunet.legend.peak_currents import (
    LENGTH,
    currents_about_peak,
    heights,
    most_frequent,
)
from cpunet.legend.realistic_library import TOLD, Made, describe
from cpunet.legend.ring_padding import continued, with_rings
from cpunet.legend.templates import TemplateTranslator
from cpunet.outputs import written_aside
from cpunet.progress import Stage, stage
from cpunet.pulses.writing import FileInTheMaking
from cpunet.training.run import Run
from cpunet.translation.translator import REN

ROWS = 16  # rows of r translated at a time
STEP_SAMPLE, STEP_LENGTH = 500, 3000  # of a charge step to measure the delay

Floats = npt.NDArray[np.float32]


def translate_for_production(
    run: Run,
    ren: REN,
    source: Path,
    out: Path,
    *,
    detectors: Sequence[str],
    rings: int,
    rank: int | None,
) -> dict[str, Any]:
    """Translate libraries of ideal charge pulses to the format of LEGEND's production.

    Each template is translated without noise, differentiated, averaged three times over 48 ns
    and shifted so that its maximum is at sample 1,000 of 4,001.  All are divided by the mode of
    A/E of the library and written as float32.  ``drift_time_*_deg`` are the times of the maxima
    minus that of a step of charge at time 0.  The grid is padded around the crystal: currents
    there are means of their neighbours, and drift times are extrapolated linearly.

    With a rank, so many components and the coefficients of each grid point are written instead
    of templates; see `cpunet.legend.realistic_library.read_library`.

    Returns
    -------
    dict
        By name of the library: ``templates`` (grid points times angles), ``translated``,
        ``padded``, ``healed`` (filled grid points inside the crystal that had no template),
        ``mode_per_ns`` (A/E by which currents are divided), and ``loss`` of the components.

    Raises
    ------
    CpunetError
        If the file contains no such library, or it is damaged, of another detector or
        sampling period.
    """
    if not 0 <= rings <= 100:
        raise CpunetError(f"`rings` {rings}: give 0 to 100 rings of padding")
    if rank is not None and not 1 <= rank <= 1000:
        raise CpunetError(f"`low_rank` {rank}: give 1 to 1000 components")
    told: dict[str, Any] = {}
    with opened(source) as given:
        names = chosen_libraries(given, source, detectors, known_detector(run))
        ideal = [IdealLibrary.of(given, name, source) for name in names]
        made_from = {"run": run.name, "weights": run.weights_sha256, "ideal": str(source)}
        with written_aside(out) as aside, FileInTheMaking(aside, out) as made:
            for library in ideal:
                looked = _look(ren, library, given[library.path], source)
                group = made.h5.require_group(library.path)
                job = _Writing(looked, library, rings, rank)
                told[library.path] = job.write(given[library.path], group, made_from)
    return told


def in_words(told: Mapping[str, Any]) -> str:
    """Numbers of a library as text."""
    healed = f", {told['healed']} of them within it" if told["healed"] else ""
    text = (
        f"{told['translated']} of {told['templates']} templates translated, "
        f"{told['padded']} added about the crystal{healed}; A/E is most often "
        f"{told['mode_per_ns']:.4g}/ns"
    )
    if loss := told.get("loss"):
        text += (
            f"\n{told['rank']} components: samples within {loss['largest']:.1e} of the "
            f"most frequent A/E (RMS {loss['rms']:.1e}), A/E within "
            f"{loss['a_over_e_percent']:.2g} % (RMS {loss['a_over_e_rms_percent']:.2g} %)"
        )
    return text


@dataclass(eq=False)
class _Looked:
    """Results of a first pass over all templates of a library, and their translator."""

    translate: TemplateTranslator
    delay_ns: float
    mode: float
    kept: Floats
    inside: dict[str, npt.NDArray[np.bool_]] = field(default_factory=dict)


def _look(
    ren: REN,
    library: IdealLibrary,
    given: h5py.Group,
    source: Path,
) -> _Looked:
    """First pass over all templates, to find the mode of A/E before any is written."""
    translate = TemplateTranslator(ren, library.dt_ns)
    step = np.zeros((1, STEP_LENGTH), np.float32)
    step[:, STEP_SAMPLE:] = 1
    _, delay = currents_about_peak(translate(step)[0])
    rng = np.random.default_rng(0)
    share = min(1.0, 2 * MAX_TEMPLATES / max(library.n_templates, 1))
    amplitudes, kept, inside = [], [], {}
    moving = not_ending = 0
    with stage(f"A/E of {library.path}", library.n_templates) as bar:
        for angle in library.angles:
            mask = np.zeros((len(library.r_mm), len(library.z_mm)), bool)
            for first, block in _blocks(given[f"waveform_{angle}"], library, source):
                there = ~np.isnan(block[:, :, 0])
                templates = block[there]
                currents, times = currents_about_peak(translate(templates)[0])
                good = np.isfinite(times)
                there[there] = good
                mask[first : first + len(block)] = there
                moving += int(good.sum())
                not_ending += n_not_ending(templates[good])
                amplitudes.append(heights(currents[good]))
                kept.append(currents[good][rng.random(int(good.sum())) < share])
                bar.update(block.shape[0] * block.shape[1])
            inside[angle] = mask
    require_charge(f"{source}: {library.path}", library.n_templates, moving, not_ending)
    require_complete(inside, library, source)
    mode = most_frequent(np.concatenate(amplitudes))
    some = np.concatenate(kept)
    if len(some) > MAX_TEMPLATES:
        some = some[np.sort(rng.choice(len(some), MAX_TEMPLATES, replace=False))]
    return _Looked(
        translate, float(delay[0]) - STEP_SAMPLE, mode, some / np.float32(mode), inside
    )


@dataclass(frozen=True, eq=False)
class _Writing:
    """Second pass, which writes one library."""

    looked: _Looked
    library: IdealLibrary
    rings: int
    rank: int | None

    def write(
        self, given: h5py.Group, group: h5py.Group, made_from: dict[str, str]
    ) -> dict[str, Any]:
        looked, library = self.looked, self.library
        r_mm, z_mm = library.padded_axes(self.rings)
        basis = None if self.rank is None else components(looked.kept, self.rank)
        made = Made.begin(group, r_mm, z_mm, library.dt_ns, basis)
        padded = healed = 0
        loss = Loss()
        for angle in library.angles:
            arrays = made.angle(angle)
            mask = looked.inside[angle]
            times = np.full((len(r_mm), len(z_mm)), np.nan)
            with stage(f"{library.path}, {angle}", len(r_mm)) as bar:
                for rows, currents, when in self._rows(given[f"waveform_{angle}"], bar):
                    arrays.put(rows, currents, loss)
                    times[rows] = when
            times = continued(times, self.rings)
            arrays.put_times(times)
            padded += int(np.isfinite(times).sum() - mask.sum())
            inner = np.isfinite(times[: len(mask), self.rings :][:, : mask.shape[1]])
            healed += int((inner & ~mask & enclosed(mask)).sum())
        numbers: dict[str, Any] = {
            "templates": library.n_templates,
            "translated": sum(int(mask.sum()) for mask in looked.inside.values()),
            "padded": padded,
            "healed": healed,
            "mode_per_ns": looked.mode,
            "delay_ns": looked.delay_ns,
        }
        if basis is not None:
            numbers["rank"] = len(basis)
            numbers["loss"] = loss.told()
        content = {"cpunet": cpunet.__version__, "rings": self.rings} | made_from | numbers
        group.attrs[TOLD] = json.dumps(content)
        describe(group)
        return numbers

    def _rows(
        self, given: h5py.Dataset, bar: Stage
    ) -> Iterator[tuple[slice, Floats, npt.NDArray[np.float64]]]:
        """Rows of the padded grid: normalised currents, and drift times within the crystal."""
        n_r, n_z, _ = given.shape
        rings, looked = self.rings, self.looked
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
                of_these, when = currents_about_peak(looked.translate(charge[there])[0])
                inner = (slice(0, high - low), slice(rings, rings + n_z))
                currents[inner][there] = of_these / np.float32(looked.mode)
                times[inner][there] = when - looked.delay_ns
            own = slice(first - low, last - low)
            yield slice(first, last), with_rings(currents, rings)[own], times[own]
            bar.update(last - first)


def _blocks(
    given: h5py.Dataset, library: IdealLibrary, source: Path
) -> Iterator[tuple[int, Floats]]:
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
        yield first, _charge(values)


def _charge(values: npt.NDArray[Any]) -> Floats:
    """Templates as float32; those of only zeros become NaN."""
    charge = np.array(values, np.float32)
    charge[~charge.any(axis=2)] = np.nan
    return charge


def enclosed(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Mask of grid points between others on all four sides, at any distance."""
    sides = [
        np.logical_or.accumulate(np.flip(mask, axis) if back else mask, axis)
        for axis in (0, 1)
        for back in (False, True)
    ]
    below, above, left, right = sides
    return np.asarray(below & np.flip(above, 0) & left & np.flip(right, 1))
