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
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_fill_holes

import cpunet
from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened, units_of
from cpunet.legend.currents import (
    LENGTH,
    PEAK,
    RINGS,
    Floats,
    Values,
    add_rings,
    currents_about_peak,
    most_frequent,
    padded_axis,
)
from cpunet.legend.library_files import PERIOD_NS, WAVEFORM, describe, libraries_in, put
from cpunet.networks.response_layer import padding
from cpunet.outputs import refuse_existing
from cpunet.progress import stage
from cpunet.pulses.container import FloatArray, blocks
from cpunet.pulses.writing import written_hdf5
from cpunet.settings import read_values
from cpunet.training.run import Run, RunLike, used_run
from cpunet.translation.backends import ResponseBackend
from cpunet.translation.translator import BATCH, REN
from cpunet.units import factor, unit_names

log = logging.getLogger(__name__)

LARGEST_MM = 500.0  # upper limit of coordinates in a crystal
ROWS = 16  # rows of r read at a time
MIN_END = 0.5  # of the maximum; templates of charge end near it, those of current do not
STEP_SAMPLE, STEP_LENGTH = 500, 3000  # of a charge step to measure the delay


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

    def delay_ns(self) -> float:
        """Time of the largest averaged current after a step of charge, sampled at 1 ns."""
        step = np.zeros((1, STEP_LENGTH), np.float32)
        step[:, STEP_SAMPLE:] = 1
        return float(currents_about_peak(self(step))[1][0]) - STEP_SAMPLE


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
    translate, numbers = TemplateTranslator(REN.of(run), PERIOD_NS), dict[str, LibraryNumbers]()
    with opened(source) as given:
        names = chosen_libraries(given, source, detector, known_detector(run))
        axes = [library_axes(given, name, source) for name in names]
        made_from = {"run": run.name, "weights": run.weights_sha256, "ideal": str(source)}
        with written_hdf5(out) as (made, _):
            for name, (r_mm, z_mm) in zip(names, axes, strict=True):
                group = made.require_group(name)
                numbers[name] = _write(
                    translate, given[name], r_mm, z_mm, group, f"{source}: {name}"
                )
                content = {"cpunet": cpunet.__version__, "rings": RINGS, **made_from}
                group.attrs["cpunet"] = json.dumps(content | asdict(numbers[name]))
                describe(group)
    return TranslatedLibrary(out, numbers)


def chosen_libraries(
    file: h5py.File, source: Path, wanted: Sequence[str], name: str | None
) -> list[str]:
    """Paths of the libraries to translate.

    Parameters
    ----------
    file, source
        The file and its name.
    wanted
        Names given by the user, or an empty sequence.
    name
        Detector that the run was trained with; None if unknown.

    Raises
    ------
    CpunetError
        If there is no library, a named one is missing, or none belongs to the detector of the
        run.
    """
    names = libraries_in(file)
    if not names:
        raise CpunetError(
            f"{source}: no pulse-shape library (no array waveform_000_deg or the like); give a "
            "struct{r, z, dt, t0, waveform_000_deg}"
        )
    held = ", ".join(path or "/" for path in names)
    chosen = list(dict.fromkeys(wanted)) or ([name] if name else names)
    for missing in (path for path in chosen if path not in names):
        if wanted:
            raise CpunetError(f"{source}: no library of {missing}; the file has {held}")
        raise CpunetError(
            f"{source}: a library of {held}, but the run was trained with a simulation of "
            f"{name}; give the library of {name}, or `detector` {names[0]} to use this one "
            "all the same"
        )
    return chosen


def known_detector(run: Run) -> str | None:
    """Name of the detector whose simulation a run was trained with; None if unknown."""
    if run.folder is not None:
        with suppress(CpunetError):  # only a calibrated run has it
            if name := read_values(run.folder / "detector.yaml").get("name"):
                return str(name)
    return run.sim.detector


def library_axes(file: h5py.File, path: str, source: Path) -> tuple[Values, Values]:
    """Grid points of a library in r and z, in mm.

    Raises
    ------
    CpunetError
        If the library does not follow the schema, or its templates are not sampled every
        nanosecond.
    """
    where, group, axes = f"{source}: {path or '/'}", file[path or "/"], list[Values]()
    if not path:
        raise CpunetError(
            f"{source}: the library stands at the top of the file; production finds it "
            "under the detector's name: write it into a group of this name"
        )
    if missing := sorted({"r", "z", "dt"} - set(group)):
        raise CpunetError(f"{where}: no {missing[0]} with the waveforms; complete the library")
    for name in ("r", "z"):
        column, units = group[name], units_of(group[name])
        if (mm_per_unit := factor(units, "mm")) is None:
            expected = unit_names("mm")
            raise CpunetError(f"{where}: {name} is in {units!r}; expected one of {expected}")
        numbers = is_column(column) and column.ndim == 1 and len(column) > 1
        values = np.asarray(column[()] if numbers else [0, 0], np.float64) * mm_per_unit
        if not (np.isfinite(values).all() and (np.diff(values) > 0).all()):
            raise CpunetError(
                f"{where}: {name} does not ascend from node to node; write the library again"
            )
        if np.abs(values).max() > LARGEST_MM:
            raise CpunetError(
                f"{where}: {name} reaches {np.abs(values).max():g} mm, beyond any crystal; are "
                f"its units ({units}) right?"
            )
        axes.append(values)
    dt, units = group["dt"], units_of(group["dt"])
    dt_ns = (factor(units, "ns") or np.nan) * dt[()].item() if is_column(dt) else np.nan
    if not np.isclose(dt_ns, PERIOD_NS):
        raise CpunetError(
            f"{where}: sampled every {dt_ns:g} ns (dt in {str(units)!r}), production reads "
            "templates of 1 ns; make the library with a period of 1 ns"
        )
    for name in filter(WAVEFORM.fullmatch, group):
        values = group[name]
        numbers = isinstance(values, h5py.Dataset) and values.dtype.kind in "iuf"
        shape: tuple[int, ...] = values.shape if numbers else ()
        if len(shape) != 3 or shape[:2] != (len(axes[0]), len(axes[1])) or shape[2] < 3:
            raise CpunetError(
                f"{where}/{name}: shape {shape} with r and z of {len(axes[0])} and "
                f"{len(axes[1])}; expected numbers of shape (r, z, samples)"
            )
    return axes[0], axes[1]


def _write(
    translate: TemplateTranslator,
    library: h5py.Group,
    r_mm: Values,
    z_mm: Values,
    group: h5py.Group,
    where: str,
) -> LibraryNumbers:
    """Write currents, and drift times within the crystal and about it.

    Raises
    ------
    CpunetError
        If an azimuth has no template, a row of r or of z has none although rows on both sides
        of it have, or most are no pulses of charge.
    """
    delay_ns = translate.delay_ns()
    shape = len(r_mm) + RINGS, len(z_mm) + 2 * RINGS  # none at negative radii
    inner = np.s_[: len(r_mm), RINGS:-RINGS]
    angles = sorted(filter(WAVEFORM.fullmatch, library))
    currents, times = dict[str, Floats](), dict[str, Values]()
    inside = dict[str, npt.NDArray[np.bool_]]()
    templates, not_ending = len(r_mm) * len(z_mm) * len(angles), 0
    with stage(f"Translating {library.name.strip('/')}", templates) as bar:
        for name in angles:
            angle = name.removeprefix("waveform_")
            currents[angle] = np.full((*shape, LENGTH), np.nan, np.float32)
            times[angle] = np.full(shape, np.nan)
            within = currents[angle][inner], times[angle][inner]
            for rows in blocks(len(r_mm), ROWS):
                charge = np.array(library[name][rows], np.float32)
                missing = np.isnan(charge)
                part = np.argwhere(missing.any(axis=2) & ~missing.all(axis=2))
                if len(part):
                    r, z = r_mm[rows][part[0, 0]], z_mm[part[0, 1]]
                    raise CpunetError(
                        f"{where}: {len(part)} templates hold NaN among their samples, the "
                        f"first at r {r:g}, z {z:g} mm of {name}; simulate the library again, "
                        "with longer records if charge was late"
                    )
                held = charge.any(axis=2) & ~missing[:, :, 0]  # only zeros are no template
                charge = charge[held]
                within[0][rows][held], when = currents_about_peak(translate(charge))
                within[1][rows][held] = when - delay_ns
                late = charge[:, -1] < MIN_END * np.abs(charge).max(axis=1)
                not_ending += int((np.isfinite(when) & late).sum())
                bar.update(held.size)
            inside[angle] = np.isfinite(within[1])
            _require_complete(inside[angle], angle, r_mm, z_mm, where)
    translated = sum(int(mask.sum()) for mask in inside.values())
    if 2 * not_ending > translated:
        raise CpunetError(
            f"{where}: {not_ending} of {translated} templates end below half of their "
            "maximum: these are currents, of negative sign, or behind electronics already; "
            "give the library of charge pulses"
        )
    amplitudes = [currents[a][inner][mask, PEAK] for a, mask in inside.items()]
    mode = most_frequent(np.concatenate(amplitudes).astype(float))

    put(group, "r", padded_axis(r_mm, 0, RINGS), "mm")
    put(group, "z", padded_axis(z_mm, RINGS, RINGS), "mm")
    put(group, "dt", PERIOD_NS, "ns")
    put(group, "t0", -PEAK * PERIOD_NS, "ns")
    padded = healed = 0
    for angle, mask in inside.items():
        currents[angle] /= np.float32(mode)
        add_rings(currents[angle], times[angle])
        put(group, f"waveform_{angle}", currents.pop(angle), "")
        put(group, f"drift_time_{angle}", times[angle].astype(np.float32), "ns")
        filled = np.isfinite(times[angle])
        padded += int(filled.sum() - mask.sum())
        healed += int((filled[inner] & ~mask & binary_fill_holes(mask)).sum())
    return LibraryNumbers(templates, translated, padded, healed, mode, delay_ns)


def _require_complete(
    mask: npt.NDArray[np.bool_], angle: str, r_mm: Values, z_mm: Values, where: str
) -> None:
    """Raise an error if an azimuth lacks whole rows of grid points between others, or all."""
    if not mask.any():
        raise CpunetError(
            f"{where}: no template of {angle} can be translated; are they charge pulses? "
            "Simulate this azimuth again, or leave it out"
        )
    for name, axis, rows in (("r", r_mm, mask.any(axis=1)), ("z", z_mm, mask.any(axis=0))):
        held = np.flatnonzero(rows)
        missing = np.setdiff1d(np.arange(held[0], held[-1]), held)
        if len(missing):
            raise CpunetError(
                f"{where}: {len(missing)} rows of {angle} are NaN between others, the first at "
                f"{name} {axis[missing[0]]:g} mm; simulate these places again"
            )
