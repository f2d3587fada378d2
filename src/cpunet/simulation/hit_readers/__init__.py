"""Readers of hits: remage LH5, CSV and HDF5 of Geant4 and g4simple, NPZ."""

from cpunet.simulation.hit_readers.reading import (
    TIME_WINDOW_US,
    hit_detectors,
    hit_parts,
    holds_hits,
    read_hits,
)
from cpunet.simulation.hit_readers.steps import ReadHits, Transform

__all__ = [
    "TIME_WINDOW_US",
    "ReadHits",
    "Transform",
    "hit_detectors",
    "hit_parts",
    "holds_hits",
    "read_hits",
]
