"""Merging of hits against scipy's single linkage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.cluster.hierarchy import fcluster, linkage

from cpunet.errors import CpunetError
from cpunet.simulation.clustering import cluster_hits
from cpunet.simulation.hits import Hits


def event_of(n: int, seed: int) -> Hits:
    rng = np.random.default_rng(seed)
    return Hits.of(rng.uniform(0, 10, (n, 3)), rng.uniform(0.1, 900, n), [0, n])


@given(st.integers(2, 30), st.integers(0, 10_000), st.floats(0, 20))
def test_the_same_as_single_linkage(n: int, seed: int, distance: float) -> None:
    hits = event_of(n, seed)
    label = fcluster(linkage(hits.position_mm), distance, criterion="distance")
    truth = np.sort(np.bincount(label, weights=hits.edep_kev)[1:])
    np.testing.assert_allclose(np.sort(cluster_hits(hits, distance).edep_kev), truth)


@given(st.lists(st.integers(0, 12), max_size=6), st.floats(0, 50))
def test_energy_and_centre_of_each_event_stay(counts: list[int], distance: float) -> None:
    hits = Hits.concatenate(
        [Hits.of([], [], [0]), *(event_of(n, seed) for seed, n in enumerate(counts))]
    )
    merged = cluster_hits(hits, distance)
    np.testing.assert_allclose(merged.energy_kev, hits.energy_kev, rtol=1e-12)
    for axis in ("x_mm", "y_mm", "z_mm"):
        before, after = (
            np.bincount(h.event_of_hit, h.edep_kev * getattr(h, axis), minlength=len(counts))
            for h in (hits, merged)
        )
        np.testing.assert_allclose(after, before, rtol=1e-9)
    np.testing.assert_array_equal(merged.event_number, hits.event_number)


def test_chains_are_one_and_events_are_not_mixed() -> None:
    chain = Hits.of([[0, 0, 0], [2, 0, 0], [1, 0, 0]], [1.0, 1.0, 2.0], [0, 3])
    merged = cluster_hits(Hits.concatenate([chain, chain]), 1.0)
    np.testing.assert_allclose(merged.x_mm, [1, 1])
    np.testing.assert_allclose(merged.edep_kev, [4, 4])


@pytest.mark.parametrize("distance", [-1.0, float("nan"), float("inf")])
def test_no_distance_is_refused(distance: float) -> None:
    with pytest.raises(CpunetError, match="give 0 or more"):
        cluster_hits(event_of(3, 0), distance)
