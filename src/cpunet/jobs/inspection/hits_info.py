"""Describe the content of a file of hits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.jobs.inspection.hit_frame import describe_frame
from cpunet.pulses.peaks import label_peaks
from cpunet.recipes.schema import PeakConfig
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_readers import hit_detectors, read_hits
from cpunet.simulation.hits import Hits

Units = tuple[str | None, str | None]


def describe_hits(
    path: Path,
    detector: str | None,
    peaks: Mapping[str, PeakConfig],
    crystal: Detector | None = None,
    units: Units = (None, None),
) -> dict[str, Any]:
    """Describe the hits of a file, detector by detector.

    Parameters
    ----------
    path
        A file for which `holds_hits` is true.
    detector
        Detector to describe; None for all.
    peaks
        Gamma lines whose events are counted, by the energy deposited.
    crystal
        Crystal in which the hits should lie.
    units
        Units of lengths and energies, if the file names none.

    Returns
    -------
    dict
        ``kind`` (``"hits"``), ``path``, and ``detectors``: by name (``""`` if the file names
        none) ``events``, ``hits``, ``energy_kev`` (lowest and highest of an event), ``x_mm``,
        ``y_mm``, ``z_mm``, ``r_mm`` (lowest and highest, in the frame of the file less a known
        origin), ``peaks`` and, with `crystal`, ``crystal`` (result of `describe_frame`); or
        the reason why the hits cannot be read.
    """
    names: list[str | None] = [*hit_detectors(path)] if detector is None else [detector]
    return {
        "kind": "hits",
        "path": str(path),
        "detectors": {
            name or "": _of_detector(path, name, peaks, crystal, units)
            for name in names or [None]
        },
    }


def _of_detector(
    path: Path,
    name: str | None,
    peaks: Mapping[str, PeakConfig],
    crystal: Detector | None,
    units: Units,
) -> dict[str, Any] | str:
    length, energy = units
    try:
        hits = read_hits(path, detector=name, length_unit=length, energy_unit=energy).hits
    except CpunetError as error:
        return str(error).removeprefix(f"{path}: ")
    told = _summary(hits, peaks)
    return told if crystal is None else told | {"crystal": describe_frame(hits, crystal)}


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
