"""What is in a file of hits, and whether they lie in the crystal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.peaks import label_peaks
from cpunet.recipes.schema import PeakConfig
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_files import hit_detectors, read_hits
from cpunet.simulation.hits import HitOptions, Hits
from cpunet.tables import counted, span

# More hits outside the crystal are those of another frame, or of another detector.
_MISPLACED_PERCENT = 1.0


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
        origin), ``peaks`` and, with `crystal`, ``crystal``: its ``name``, ``radius_mm`` and
        ``length_mm``, and ``outside_percent`` of the hits; or the reason why they cannot be
        read.
    """
    chosen = options.hits_detector
    names: list[str | None] = [*hit_detectors(path)] if chosen is None else [chosen]

    def of_detector(name: str | None) -> dict[str, Any] | str:
        try:
            as_in_file = replace(options, hits_detector=name, origin=(0, 0, 0), flip_z=False)
            hits = read_hits(path, as_in_file)
        except CpunetError as error:
            return str(error).removeprefix(f"{path}: ")
        summary = _summary(hits, peaks)
        if crystal is None:
            return summary
        x, y, z = options.to_crystal(hits.position_mm).T
        outside = ~crystal.inside(np.hypot(x, y), z)
        return summary | {
            "crystal": {
                "name": crystal.name,
                "radius_mm": crystal.crystal_radius,
                "length_mm": crystal.crystal_length,
                "outside_percent": 100 * float(outside.mean()),
            }
        }

    detectors = {name or "": of_detector(name) for name in names or [None]}
    return {"path": str(path), "detectors": detectors}


def _summary(hits: Hits, peaks: Mapping[str, PeakConfig]) -> dict[str, Any]:
    names, counts = np.unique(label_peaks(hits.energy_kev, peaks), return_counts=True)
    counted = dict(zip(map(str, names), counts.tolist(), strict=True))
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


def hits_in_words(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and texts for the result of `describe_hits`."""
    lines = [("file", str(found["path"]))]
    for name, one in found["detectors"].items():
        if name:
            lines.append(("detector", name))
        lines += [("hits", one)] if isinstance(one, str) else _hits_of(one)
    return lines


def _hits_of(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    extents = ", ".join(f"{axis} {span(found[f'{axis}_mm'], 2)}" for axis in "xyzr")
    lines = [
        ("hits", f"{found['hits']} of {found['events']} events"),
        ("energy", f"{span(found['energy_kev'])} keV an event"),
        ("lines", counted(found["peaks"])),
        ("extents", f"{extents} mm"),
    ]
    crystal = found.get("crystal")
    if crystal:
        size = f"radius {crystal['radius_mm']:g} mm, z 0 to {crystal['length_mm']:g} mm"
        outside = crystal["outside_percent"]
        misplaced = outside > _MISPLACED_PERCENT
        remedy = "; check `origin`, `flip_z` and the dimensions" if misplaced else ""
        lines += [
            ("crystal", f"{crystal['name']}, {size}"),
            ("outside", f"{outside:.2f} % of the hits{remedy}"),
        ]
    return [(n, t) for n, t in lines if t]
