"""A page that shows a crystal's pulses point by point: ideal, translated, measured.

The page is self-contained: pulses are embedded as 16-bit integers, and it makes no requests.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.analysis.chart_data import method_looks
from cpunet.analysis.html_pages import rendered, script
from cpunet.analysis.nearest import Nearest
from cpunet.analysis.paired import align_half_maximum
from cpunet.analysis.style import COLOURS
from cpunet.analysis.view_parts import packed
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import PARAMETERS, Values, current_amplitude_kernel
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.recipes.schema import Recipe
from cpunet.simulation.geometry import POINT_CONTACT, Detector

Indices = npt.NDArray[np.int64]

EDGE = 150  # samples on each side of half maximum that are all kept
TAIL_STEP = 4  # step between the later samples that are kept
NUMBERS = {
    "drift_time": (PARAMETERS["drift_time"].label, "ns", 1),
    "current_amplitude": ("Current amplitude", "1/sample", 5),
    "rise_10_90": ("Rise time 10–90 %", "ns", 1),
}
SCRIPTS = ("marks", "plot", "legend", "crystal", "explorer")  # in order
_OUTLINE_POINTS = 500  # along the longer side of the crystal
_MAP_COLOURS = 64


@dataclass(frozen=True, eq=False)
class Exploration:
    """Content of the page.

    Parameters
    ----------
    detector
        Detector whose name and outline are shown.
    recipe
        Recipe of the runs, with preparation and scores.
    runs
        Names of the runs.
    dt_ns
        Sampling period of all pulses in ns.
    step_mm
        Spacing of the grid points in mm.
    r_mm, z_mm
        Grid points in the crystal in mm, each of shape ``(points,)``.
    missing
        Reason why a grid point has no pulse, ``""`` where it has one.
    ideal
        Prepared simulated windows of the points with a pulse, shape ``(n, samples)``.
    translated
        Noise-free translations by each run, shape ``(runs, n, samples)``.
    measured, nearest
        Prepared measured pulses, and which of them are drawn, if any.
    notes
        Lines of plain text for the page footer.
    """

    detector: Detector
    recipe: Recipe
    runs: tuple[str, ...]
    dt_ns: float
    step_mm: float
    r_mm: Values
    z_mm: Values
    missing: tuple[str, ...]
    ideal: FloatArray
    translated: FloatArray
    measured: Pulses | None = None
    nearest: Nearest | None = None
    notes: tuple[str, ...] = ()


def explorer_page(shown: Exploration) -> str:
    """Return the page as HTML.

    Parameters
    ----------
    shown
        Content of the page.
    """
    content = _content(shown)
    return rendered(
        "explorer.html",
        title=f"Pulses of {shown.detector.name or 'a detector'} by place",
        page=content,
        script=script(content, SCRIPTS),
    )


def _content(shown: Exploration) -> dict[str, Any]:
    reasons = sorted({reason for reason in shown.missing if reason})
    kept = np.array([not reason for reason in shown.missing])
    row = np.where(kept, np.cumsum(kept) - 1, -1)
    samples = _samples(shown.recipe)
    return {
        "detector": shown.detector.name,
        "runs": shown.runs,
        "dt_ns": shown.dt_ns,
        "step_mm": shown.step_mm,
        "r_mm": _rounded(shown.r_mm, 3),
        "z_mm": _rounded(shown.z_mm, 3),
        "row": row.tolist(),
        "reason": [reasons.index(r) if r else -1 for r in shown.missing],
        "reasons": reasons,
        "samples": samples.tolist(),
        "edge": int((samples < EDGE).sum()),
        "kernel": _rounded(_smoothing(), 7),
        "names": {name: [label, unit] for name, (label, unit, _) in NUMBERS.items()},
        "methods": _methods(shown),
        "contact": COLOURS["truth"],
        "map": _colour_map(),
        "outline": _outlines(shown.detector),
        "notes": shown.notes,
        "ideal": {
            "wave": _packed(_drawn(shown.ideal, samples)),
            "numbers": _told(_numbers(shown.ideal, shown)),
        },
        "ren": _of_runs(shown, samples),
        "measured": _measured(shown, samples),
    }


def _methods(shown: Exploration) -> list[dict[str, Any]]:
    """Rows of the legend: simulation, translation, and one for each nearest measured pulse."""
    ranks = range(shown.nearest.index.shape[1] if shown.nearest else 0)
    data = method_looks(["data"])[0]
    return method_looks(["raw", "ren"]) + [
        data | {"name": f"data {n + 1}", "label": f"{data['label']} {n + 1}"} for n in ranks
    ]


def _samples(recipe: Recipe) -> Indices:
    """Drawn samples, counted from half maximum: the whole edge, part of the tail."""
    before, after = recipe.preparation.samples_before, recipe.preparation.samples_after
    edge = np.arange(-min(EDGE, before), min(EDGE, after))
    return np.concatenate([edge, np.arange(EDGE, after, TAIL_STEP)])


def _drawn(windows: FloatArray, samples: Indices) -> FloatArray:
    """Windows aligned at half maximum, at the drawn samples."""
    before = -int(samples[0])
    aligned = align_half_maximum(windows, before, int(samples[-1]) + 1)
    return aligned[:, samples + before]


def _of_runs(shown: Exploration, samples: Indices) -> dict[str, Any]:
    """Translation and parameters; of several runs their mean, spread and bands."""
    drawn = np.stack([_drawn(windows, samples) for windows in shown.translated])
    by_run = [_numbers(windows, shown) for windows in shown.translated]
    wave = _packed(drawn.mean(axis=0))
    if len(by_run) == 1:
        return {"wave": wave, "numbers": _told(by_run[0])}
    edge = int((samples < EDGE).sum())
    current = np.stack([_current(waves[:, :edge]) for waves in drawn])
    # one run without a value leaves the grid point without one
    columns = {name: np.stack([numbers[name] for numbers in by_run]) for name in NUMBERS}
    told: dict[str, Any] = {
        "wave": wave,
        "numbers": _told({name: values.mean(axis=0) for name, values in columns.items()}),
        "spread": _told({n: values.std(axis=0, ddof=1) for n, values in columns.items()}, 2),
    }
    for name, values in (("band", drawn), ("current_band", current)):
        told[name] = [_packed(values.min(axis=0)), _packed(values.max(axis=0))]
    return told


def _measured(shown: Exploration, samples: Indices) -> dict[str, Any] | None:
    """The measured pulses that are nearest to any grid point, each once."""
    if shown.measured is None or shown.nearest is None:
        return None
    rows, index = np.unique(shown.nearest.index, return_inverse=True)
    pulses = shown.measured[rows]
    return {
        "wave": _packed(_drawn(pulses.waveforms, samples)),
        "numbers": _told(_numbers(pulses.waveforms, shown)),
        "energy_kev": _rounded(pulses.energy_kev, 1),
        "event_number": pulses.event_number.tolist(),
        "nearest": index.reshape(shown.nearest.index.shape).tolist(),
        "rms": [_rounded(rms, 5) for rms in shown.nearest.rms],
    }


def _numbers(windows: FloatArray, shown: Exploration) -> Mapping[str, Values]:
    pulses = Pulses.of(windows, dt_ns=shown.dt_ns)
    values = all_parameters(pulses, shown.recipe.preparation, shown.recipe.scores)
    return {name: values[name] for name in NUMBERS}


def _told(numbers: Mapping[str, Values], more_digits: int = 0) -> dict[str, list[float | None]]:
    return {
        name: _rounded(numbers[name], digits + more_digits)
        for name, (_, _, digits) in NUMBERS.items()
    }


def _smoothing() -> Values:
    """The moving averages of the current amplitude, about the middle of a sample."""
    weights = current_amplitude_kernel().astype(float)
    lever = np.arange(weights.shape[1]) - weights.shape[1] // 2
    return np.asarray(weights[np.abs(weights @ lever).argmin()])


def _current(waves: FloatArray) -> FloatArray:
    """Smoothed current per sample, midway between samples; shortened by the smoothing."""
    kernel = _smoothing()[::-1]
    rise = np.diff(waves.astype(float), axis=1)
    return np.stack([np.convolve(one, kernel, "valid") for one in rise]).astype(np.float32)


def _packed(values: FloatArray) -> dict[str, Any]:
    return packed(values, about_zero=True)


def _rounded(values: npt.NDArray[Any], digits: int) -> list[float | None]:
    return [round(float(v), digits) if np.isfinite(v) else None for v in values]


def _colour_map() -> list[str]:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colour) for colour in colormaps["viridis"](np.linspace(0, 1, _MAP_COLOURS))]


def _outlines(detector: Detector) -> dict[str, Any]:
    """Closed outlines (r, z in mm) of crystal, active germanium and point contact."""
    from matplotlib.figure import Figure

    length, radius = detector.crystal_length, detector.crystal_radius
    step = max(length, radius) / _OUTLINE_POINTS
    # nodes half a step off the axis and the face, so that outlines run along these
    r, z = (np.arange(-0.5, side / step + 2) * step for side in (radius, length))
    rr, zz = np.meshgrid(r, z)
    within = (rr > 0) & (zz > 0)
    masks = {
        "crystal": within & detector.inside(rr, zz),
        "active": within & detector.active(rr, zz),
        "contact": within & (detector.region(rr, zz) == POINT_CONTACT),
    }
    axes = Figure().subplots()
    lines = {
        name: [
            np.round(line, 2).tolist()
            for line in axes.contour(r, z, mask.astype(float), [0.5]).allsegs[0]
        ]
        for name, mask in masks.items()
        if mask.any()
    }
    return {"radius": radius, "length": length, **lines}
