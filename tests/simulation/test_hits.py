"""The container of hits, and their merging against scipy's single linkage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.cluster.hierarchy import fcluster, linkage

from cpunet.simulation.clustering import cluster_hits
from cpunet.simulation.hits import Hits


def hits_with(counts: list[int], seed: int = 0) -> Hits:
    rng = np.random.default_rng(seed)
    n = sum(counts)
    return Hits.of(
        rng.uniform(0, 40, (n, 3)),
        rng.uniform(1, 500, n),
        np.concatenate([[0], np.cumsum(counts)]),
        np.arange(len(counts)) * 10,
    )


@given(st.lists(st.integers(0, 5), max_size=8), st.data())
def test_picking_events_keeps_their_hits(counts: list[int], data: st.DataObject) -> None:
    hits = hits_with(counts)
    mask = np.array([data.draw(st.booleans()) for _ in counts], bool)
    picked = hits[mask]
    np.testing.assert_allclose(picked.energy_kev, hits.energy_kev[mask])
    np.testing.assert_array_equal(picked.event_number, hits.event_number[mask])
    np.testing.assert_array_equal(picked.x_mm, hits.x_mm[mask[hits.event_of_hit]])
    both = Hits.concatenate([picked, hits[~mask]])
    assert both.edep_kev.sum() == pytest.approx(hits.edep_kev.sum())
    assert len(both) == len(hits)


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
