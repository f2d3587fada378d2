"""Check whether hits lie in a crystal, and find a frame in which they do."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_readers import Transform
from cpunet.simulation.hits import Hits

MAX_HITS = 50_000  # maximum number of hits used
FITS = 0.999  # share inside above which the frame is right, but for rounding at the surface
BETTER = 0.02  # share by which another frame must be better than that of the file
CELL_R_MM, CELL_Z_MM = 4.0, 8.0  # cells in which hits are counted
EXPECTED, VOID = 20.0, 0.05  # expected hits needed to test a cell; share below which it is void
AS_IN_FILE = Transform()


def describe_frame(
    hits: Hits, detector: Detector, given: Transform = AS_IN_FILE
) -> dict[str, Any]:
    """Count the hits inside a crystal, and find a frame with more of them inside.

    A frame does not fit, however many hits are inside, if a part of the crystal has no hits,
    for example where the bore in the hits lies in germanium.

    Parameters
    ----------
    hits
        Hits in the frame of their file.
    detector
        Crystal with its point contact at z = 0.
    given
        Frame in which the hits are counted.

    Returns
    -------
    dict
        ``name``, ``radius_mm`` and ``length_mm`` of the crystal; ``inside_percent`` and
        ``outside_percent`` of the hits; and, if another frame fits better, ``fits``:
        ``origin_mm``, ``flip_z``, ``inside_percent`` and ``options``, these in words.

    Examples
    --------
    >>> from cpunet.simulation.geometry_readers import read_detector
    >>> places = np.random.default_rng(1).uniform(-30, 30, (2000, 3)) + [100, 0, 41]
    >>> told = describe_frame(Hits.of(places, np.ones(2000), [0, 2000]), read_detector("icpc"))
    >>> told["inside_percent"], told["fits"]["origin_mm"][0]
    (0.0, 100.0)
    """
    position = hits.position_mm
    if len(position) > MAX_HITS:
        position = position[
            np.random.default_rng(0).choice(len(position), MAX_HITS, replace=False)
        ]

    def inside(frame: Transform) -> float:
        x, y, z = frame.apply(position).T
        return float(detector.inside(np.hypot(x, y), z).mean())

    as_given = inside(given)
    told: dict[str, Any] = {
        "name": detector.name,
        "radius_mm": detector.crystal_radius,
        "length_mm": detector.crystal_length,
        "inside_percent": 100 * as_given,
        "outside_percent": 100 * (1 - as_given),
    }
    if as_given > FITS:
        return told
    # equally good frames keep this order: first the file's own origin and orientation
    shares = {frame: inside(frame) for frame in _frames(position, detector)}
    better = [frame for frame in shares if shares[frame] >= as_given + BETTER]
    better.sort(key=lambda frame: -shares[frame])
    frame = next((f for f in better if not _has_void(f.apply(position), detector)), None)
    if frame is None:
        return told
    origin = [float(value) for value in frame.origin_mm]
    words = [f"`origin` {' '.join(f'{value:g}' for value in origin)}"] if any(origin) else []
    words += ["`flip_z`"] if frame.flip_z else []
    return told | {
        "fits": {
            "origin_mm": origin,
            "flip_z": frame.flip_z,
            "inside_percent": 100 * shares[frame],
            "options": " ".join(words) or "neither `origin` nor `flip_z`",
        }
    }


def _frames(position: np.ndarray[Any, Any], detector: Detector) -> Iterator[Transform]:
    """Candidate frames: hits around the axis, with ends or middle at those of the crystal."""
    low, high = position.min(axis=0), position.max(axis=0)
    centres = [(0.0, 0.0), tuple((low[:2] + high[:2]) / 2)]
    for flip in (False, True):
        length = -detector.crystal_length if flip else detector.crystal_length
        near, far = (high[2], low[2]) if flip else (low[2], high[2])
        for z in (0.0, length, near, far - length, (near + far - length) / 2):
            for x, y in centres:
                yield Transform((round(x, 1) + 0.0, round(y, 1) + 0.0, round(z, 1) + 0.0), flip)


def _has_void(position: np.ndarray[Any, Any], detector: Detector) -> bool:
    """Whether a part of the crystal has no hits while others at the same height have many."""
    x, y, z = position.T
    r_edges = np.arange(0, detector.crystal_radius + CELL_R_MM, CELL_R_MM)
    z_edges = np.arange(0, detector.crystal_length + CELL_Z_MM, CELL_Z_MM)
    counts = np.histogram2d(np.hypot(x, y), z, (r_edges, z_edges))[0]
    corners = detector.inside(*np.meshgrid(r_edges, z_edges, indexing="ij"))
    whole = corners[1:, 1:] & corners[1:, :-1] & corners[:-1, 1:] & corners[:-1, :-1]
    volume = np.diff(r_edges**2)[:, np.newaxis] * whole
    layers = volume.sum(axis=0)
    density = (counts * whole).sum(axis=0) / np.where(layers, layers, 1.0)
    expected = volume * density
    return bool((whole & (expected > EXPECTED) & (counts < VOID * expected)).any())
