"""What is in a file of hits, and whether they lie in the crystal: else in which frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.peaks import label_peaks
from cpunet.recipes.schema import PeakConfig
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_frame import describe_frame
from cpunet.simulation.hit_readers import Transform, hit_detectors, read_hits
from cpunet.simulation.hits import HitOptions, Hits
from cpunet.tables import counted, span


def describe_hits(
    path: Path,
    options: HitOptions,
    peaks: Mapping[str, PeakConfig],
    crystal: Detector | None = None,
) -> dict[str, Any]:
    """Describe the hits of a file, detector by detector.

    Parameters
    ----------
    path
        A file for which `holds_hits` is true.
    options
        How it is read; all detectors if none is chosen.
    peaks
        Gamma lines whose events are counted, by the energy deposited.
    crystal
        Crystal in which the hits should lie.

    Returns
    -------
    dict
        ``path``, and ``detectors``: by name (``""`` if the file names none) ``events``,
        ``hits``, ``energy_kev`` (lowest and highest of an event), ``x_mm``, ``y_mm``,
        ``z_mm``, ``r_mm`` (lowest and highest, in the frame of the file less a known
        origin), ``peaks`` and, with `crystal`, ``crystal``
        (result of `describe_frame`); or the reason why the hits cannot be read.
    """
    chosen = options.hits_detector
    names: list[str | None] = [*hit_detectors(path)] if chosen is None else [chosen]

    def of_detector(name: str | None) -> dict[str, Any] | str:
        try:
            hits = read_hits(
                path,
                detector=name,
                length_unit=options.length_unit,
                energy_unit=options.energy_unit,
                time_window_us=options.time_window_us,
            ).hits
        except CpunetError as error:
            return str(error).removeprefix(f"{path}: ")
        told = _summary(hits, peaks)
        if crystal is None:
            return told
        frame = Transform(options.origin, options.flip_z)
        return told | {"crystal": describe_frame(hits, crystal, frame)}

    detectors = {name or "": of_detector(name) for name in names or [None]}
    return {"path": str(path), "detectors": detectors}


def _summary(hits: Hits, peaks: Mapping[str, PeakConfig]) -> dict[str, Any]:
    found, counts = np.unique(label_peaks(hits.energy_kev, peaks), return_counts=True)
    counted = dict(zip(map(str, found), counts.tolist(), strict=True))
    return {
        "events": hits.n_events,
        "hits": len(hits.edep_kev),
        "energy_kev": _ends(hits.energy_kev),
        **{f"{axis}_mm": _ends(getattr(hits, f"{axis}_mm")) for axis in "xyz"},
        "r_mm": _ends(np.hypot(hits.x_mm, hits.y_mm)),
        "peaks": {name: counted.get(name, 0) for name in peaks},
    }


def _ends(values: npt.NDArray[np.floating[Any]]) -> list[float]:
    return [float(values.min()), float(values.max())]


def hits_in_words(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and texts for the result of `describe_hits`."""
    lines = [("file", str(told["path"]))]
    for name, one in told["detectors"].items():
        if name:
            lines.append(("detector", name))
        lines += [("hits", one)] if isinstance(one, str) else _hits_of(one)
    return lines


def _hits_of(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    extents = ", ".join(f"{axis} {span(told[f'{axis}_mm'], 2)}" for axis in "xyzr")
    lines = [
        ("hits", f"{told['hits']} of {told['events']} events"),
        ("energy", f"{span(told['energy_kev'])} keV an event"),
        ("lines", counted(told["peaks"])),
        ("extents", f"{extents} mm"),
    ]
    crystal = told.get("crystal")
    if crystal:
        size = f"radius {crystal['radius_mm']:g} mm, z 0 to {crystal['length_mm']:g} mm"
        lines += [
            ("crystal", f"{crystal['name']}, {size}"),
            (
                "inside",
                f"{crystal['inside_percent']:.2f} % of the hits, outside "
                f"{crystal['outside_percent']:.2f} %",
            ),
            ("frame", _frame(crystal)),
        ]
    return [(n, t) for n, t in lines if t]


def _frame(crystal: Mapping[str, Any]) -> str:
    fits = crystal.get("fits")
    if fits:
        return f"{fits['inside_percent']:.2f} % would be inside with {fits['options']}"
    if crystal["outside_percent"] < 1:
        return "that of the crystal"
    return "no other fits; these hits are of another detector, or of other dimensions"
