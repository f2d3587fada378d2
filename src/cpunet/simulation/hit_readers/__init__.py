"""Readers of hits: remage LH5, Geant4 and g4simple CSV and HDF5, NPZ."""

from cpunet.simulation.hit_readers.reading import (
    hit_detectors,
    hit_parts,
    holds_hits,
    read_hits,
)
from cpunet.simulation.hit_readers.steps import ReadHits, Transform

__all__ = ["ReadHits", "Transform", "hit_detectors", "hit_parts", "holds_hits", "read_hits"]
