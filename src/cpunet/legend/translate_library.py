"""Translate libraries of ideal charge pulses to current libraries, as LEGEND reads them.

The layout is that of LEGEND's production (legend-simflow): per detector a ``struct{r, z, dt,
t0, waveform_000_deg, drift_time_000_deg, ...}`` of currents in units of the most frequent A/E.

A template is the charge pulse of one position in the detector.  Users of the library sum
templates weighted by energy.  Templates must therefore not be aligned or normalised, unlike in
`Translator.translate`: a readout chain acts directly on the template.

Currents of a pulse-shape library: about their maxima, and beyond the crystal.

The current of a template is averaged three times over 48 ns, like that of A in A/E, and
shifted so that its maximum is at sample `PEAK`.  The shift includes the fraction of a sample,
since half a nanosecond already changes the summed current of two sites.

Readers of a library interpolate drift times between nodes and take the template of the nearest
one.  At the surface, some nodes of a cell are outside the crystal; rings of nodes beyond it
give hits just inside their values.
"""

from __future__ import annotations

import copy
import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
from numba import prange
from scipy.ndimage import binary_fill_holes

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.kernels import kernel
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
from cpunet.networks.response_layer import padding
from cpunet.outputs import refuse_existing
from cpunet.progress import stage
from cpunet.pulses.container import FloatArray, blocks
from cpunet.pulses.writing import written_hdf5
from cpunet.training.run import RunLike, used_run
from cpunet.translation.translator import BATCH, REN

WINDOW, WINDOWS = 48, 3  # length of a moving average in ns, and number of averages
PEAK, LENGTH = 1000, 4001  # sample of the maximum, and length of a template in ns
MODE_BINS = 1000
RINGS = 3  # number of rings
_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0))

Floats = npt.NDArray[np.float32]
Values = npt.NDArray[np.float64]


def currents_about_peak(charge: FloatArray) -> tuple[Floats, Values]:
    """Average the currents, and shift their maxima to sample `PEAK`.

    Parameters
    ----------
    charge
        Charge sampled every nanosecond, 0 before the first sample, shape ``(n, samples)``.

    Returns
    -------
    currents
        Currents in units of the charge per ns, shape ``(n, LENGTH)``; 0 outside the record,
        rows of NaN for templates that contain NaN, have no maximum above 0, or have fewer
        than 3 samples.
    times_ns
        Times of the maxima after the first sample, shape ``(n,)``, including the delay of the
        backward averages, which is the same for all templates; NaN for rows of NaN.
    """
    n = len(charge)
    currents = np.full((n, LENGTH), np.nan, np.float32)
    times = np.full(n, np.nan)
    if charge.shape[1] < 3:  # no sample has two neighbours
        return currents, times
    _about_peak(np.ascontiguousarray(charge, np.float32), currents, times)
    return currents, times


def most_frequent(amplitudes: Values) -> float:
    """Mode of A/E as in production: centre of the fullest of 1,000 bins of the whole range.

    If all values are the same, it is their value.

    Parameters
    ----------
    amplitudes
        Finite values, at least one.

    Examples
    --------
    >>> round(most_frequent(np.array([1.0, 2.0, 2.0, 3.0])), 2)
    2.0
    """
    if np.ptp(amplitudes) == 0:  # the bins would be 0.001/ns wide, a tenth of A/E
        return float(amplitudes[0])
    counts, edges = np.histogram(amplitudes, MODE_BINS)
    highest = int(counts.argmax())
    return float(0.5 * (edges[highest] + edges[highest + 1]))


@kernel(parallel=True)
def _about_peak(charge: Floats, currents: Floats, times: Values) -> None:
    # arrays of NaN, filled where a template has a maximum
    n, n_samples = charge.shape
    for i in prange(n):
        current = _averaged(charge[i])
        peak = 1
        for k in range(1, n_samples - 1):
            if current[k] > current[peak]:
                peak = k
        bend = current[peak - 1] - 2 * current[peak] + current[peak + 1]
        # the running sums remain NaN after a NaN
        if np.isnan(current[-1]) or not (current[peak] > 0 and bend < 0):
            continue
        time = peak + 0.5 * (current[peak - 1] - current[peak + 1]) / bend
        times[i] = time
        first = int(np.floor(time))
        f = time - first
        # cubic interpolation with the slopes of the neighbours (Catmull and Rom)
        w0 = 0.5 * f * (-1 + f * (2 - f))
        w1 = 0.5 * (2 + f * f * (3 * f - 5))
        w2 = 0.5 * f * (1 + f * (4 - 3 * f))
        w3 = 0.5 * f * f * (f - 1)
        for j in range(currents.shape[1]):
            k = first + j - PEAK
            value = 0.0
            if 1 <= k < n_samples - 2:
                value = (
                    w0 * current[k - 1]
                    + w1 * current[k]
                    + w2 * current[k + 1]
                    + w3 * current[k + 2]
                )
            currents[i, j] = value


@kernel
def _averaged(charge: Floats) -> Values:
    """Differences between samples after the backward averages; NaN from a NaN on."""
    n_samples = len(charge)
    current = np.empty(n_samples)
    before = 0.0
    for k in range(n_samples):
        current[k] = charge[k] - before
        before = charge[k]
    averaged = np.empty(n_samples)
    for _ in range(WINDOWS):
        total = 0.0
        for k in range(n_samples):
            total += current[k]
            if k >= WINDOW:
                total -= current[k - WINDOW]
            averaged[k] = total / WINDOW
        current, averaged = averaged, current
    return current


def with_rings(templates: Floats, rings: int = RINGS) -> Floats:
    """Fill nodes without a template with the mean of their neighbours, ring by ring.

    The mean of currents that are aligned at their maxima has the mean A/E.

    Parameters
    ----------
    templates
        Templates, shape ``(r, z, samples)``, NaN if there is none; changed in place.
    rings
        Number of rings; a node depends only on nodes at most this far away.

    Returns
    -------
    numpy.ndarray
        The same array.

    Examples
    --------
    >>> line = np.array([[[1.0], [3.0], [np.nan], [np.nan]]], np.float32)
    >>> with_rings(line, 1)[0, :, 0].tolist()
    [1.0, 3.0, 3.0, nan]
    """
    filled = ~np.isnan(templates[:, :, 0])
    for _ in range(rings):
        held = np.pad(filled, 1)
        around = np.sum([_seen(held, 1, *step) for step in _NEIGHBOURS], axis=0)
        new_r, new_z = np.nonzero(~filled & (around > 0))
        total = np.zeros((len(new_r), templates.shape[2]), np.float64)
        for i, j in _NEIGHBOURS:
            near = held[new_r + 1 + i, new_z + 1 + j]
            total[near] += templates[new_r[near] + i, new_z[near] + j]
        templates[new_r, new_z] = total / around[new_r, new_z][:, np.newaxis]
        filled[new_r, new_z] = True
    return templates


def continued(times: Values, rings: int = RINGS) -> Values:
    """Extrapolate drift times linearly to nodes without one, ring by ring.

    Parameters
    ----------
    times
        Drift times in ns, shape ``(r, z)``; NaN if there is none.
    rings
        Number of rings.

    Returns
    -------
    numpy.ndarray
        Drift times in ns, shape ``(r, z)``. A new one is the mean of the linear extrapolations
        from two nodes in each of eight directions, or else the mean of its neighbours.

    Examples
    --------
    >>> continued(np.array([[4.0, 6.0, np.nan, np.nan]]), 2).tolist()
    [[4.0, 6.0, 8.0, 10.0]]
    """
    made = np.pad(times, 2, constant_values=np.nan)
    for _ in range(rings):
        near, far = (
            np.stack([_seen(made, 2, n * i, n * j) for i, j in _NEIGHBOURS]) for n in (1, 2)
        )
        inner = _seen(made, 2, 0, 0)
        best = _mean(2 * near - far)
        best = np.where(np.isnan(best), _mean(near), best)
        inner[...] = np.where(np.isnan(inner), best, inner)
    return _seen(made, 2, 0, 0).copy()


def padded_axis(axis: Values, before: int, after: int) -> Values:
    """Continue an ascending axis by its widest step on both sides.

    Examples
    --------
    >>> padded_axis(np.array([0.0, 0.5, 1.0]), 0, 2).tolist()
    [0.0, 0.5, 1.0, 1.5, 2.0]
    """
    step = float(np.diff(axis).max())
    low = axis[0] - step * np.arange(before, 0, -1)
    high = axis[-1] + step * np.arange(1, after + 1)
    return np.concatenate([low, axis, high])


def _seen(padded: npt.NDArray[Any], pad: int, i: int, j: int) -> npt.NDArray[Any]:
    """Inner part of an array with a padding of `pad` nodes, shifted by (i, j)."""
    n_r, n_z = padded.shape
    return padded[pad + i : n_r - pad + i, pad + j : n_z - pad + j]


def _mean(values: Values) -> Values:
    """Mean of the finite values along the first axis; NaN if there is none."""
    finite = np.isfinite(values)
    n = finite.sum(axis=0)
    total = np.where(finite, values, 0.0).sum(axis=0)
    return np.where(n > 0, total / np.maximum(n, 1), np.nan)


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
        if ren.backend.chain is None:
            raise CpunetError(
                "the run's network translates whole pulses, not the templates that they are "
                "summed from; give a run of the recipe fast"
            )
        if ren.backend.by_height is not None:
            log.warning(
                "templates are summed, and get the linear part of the readout alone: its slew "
                "rate and curve act on the sums"
            )
        self._chain = copy.deepcopy(ren.backend.chain)
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
                counted = _write(translate, charge, given[charge.path], group, source)
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
    source: Path,
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
            for rows, charge in _blocks(given[f"waveform_{angle}"], library, source):
                held = ~np.isnan(charge[:, :, 0])
                templates = charge[held]
                within[0][rows][held], when = currents_about_peak(translate(templates))
                within[1][rows][held] = when - delay_ns
                ends, heights = templates[:, -1], np.abs(templates).max(axis=1)
                not_ending += int((np.isfinite(when) & (ends < MIN_END * heights)).sum())
                bar.update(held.size)
    inside = {angle: np.isfinite(when[inner]) for angle, when in times.items()}
    translated = sum(int(mask.sum()) for mask in inside.values())
    where = f"{source}: {library.path}"
    if not translated:
        raise CpunetError(
            f"{where}: none of {library.n_templates} templates can be translated; are they "
            "charge pulses?"
        )
    if 2 * not_ending > translated:
        raise CpunetError(
            f"{where}: {not_ending} of {translated} templates end below half of their maximum: "
            "these are currents, of negative sign, or behind electronics already; give the "
            "library of charge pulses"
        )
    require_complete(inside, library, source)
    amplitudes = [currents[a][inner][mask, PEAK] for a, mask in inside.items()]
    mode = most_frequent(np.concatenate(amplitudes).astype(float))

    put_column(group, "r", r_mm, "mm")
    put_column(group, "z", z_mm, "mm")
    put_column(group, "dt", PERIOD_NS, "ns")
    put_column(group, "t0", -PEAK * PERIOD_NS, "ns")
    padded = healed = 0
    for angle, mask in inside.items():
        values = put_array(group, f"waveform_{angle}", (*shape, LENGTH), np.float32, "")
        drift_times = put_array(group, f"drift_time_{angle}", shape, np.float32, "ns")
        currents[angle] /= np.float32(mode)
        values[...] = with_rings(currents.pop(angle))
        drift_times[...] = filled = continued(times[angle])
        padded += int(np.isfinite(filled).sum() - mask.sum())
        healed += int((np.isfinite(filled[inner]) & ~mask & binary_fill_holes(mask)).sum())
    return LibraryNumbers(library.n_templates, translated, padded, healed, mode, delay_ns)


def _blocks(
    given: h5py.Dataset, library: IdealLibrary, source: Path
) -> Iterator[tuple[slice, Floats]]:
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
                f"{source}: {given.name}: {int(part.sum())} templates hold NaN among their "
                f"samples, the first at r {library.r_mm[first + i]:g}, z "
                f"{library.z_mm[j]:g} mm; simulate the library again, with longer records if "
                "charge was late"
            )
        charge[~charge.any(axis=2)] = np.nan
        yield slice(first, first + len(charge)), charge
