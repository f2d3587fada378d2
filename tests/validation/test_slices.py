"""Superpulses in slices of rise time against plain loops, and their errors against draws."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.special import ndtr

from cpunet.pulses.half_maximum import align_half_maximum
from cpunet.validation.slices import (
    AFTER,
    BEFORE,
    Slices,
    slice_edges,
    slice_figure,
    slice_residuals,
    slice_table,
    sliced,
)
from synthetic import require_drawn

DT = 16.0


def pulses(rng, n, width=5.0, noise=0.002):
    """Edges whose drift, a slow first third, has a random length; and their times in ns."""
    drift = rng.uniform(20, 120, n)[:, np.newaxis]
    time = np.arange(300) - 150 - rng.uniform(0, 1, n)[:, np.newaxis]
    slow = 0.3 * np.clip((time + drift) / drift, 0, 1)
    windows = slow + 0.7 * ndtr(time / width) + rng.normal(0, noise, (n, 300))
    return windows.astype(np.float32), drift[:, 0] * DT


def superpulses(windows, times, edges) -> Slices:
    return sliced(align_half_maximum(windows, BEFORE, AFTER), times, edges)


def drawn(rng, n, edges, **kwargs) -> Slices:
    windows, times = pulses(rng, n, **kwargs)
    return superpulses(windows, times, edges)


def test_edges_hold_equally_many_and_ignore_what_is_not_finite():
    times = np.append(np.random.default_rng(0).exponential(300, 4000), [np.nan, np.inf])
    edges = slice_edges(times, slices=5)
    counts = np.histogram(times[:-2], edges)[0]
    assert counts.tolist() == [800] * 5


def test_superpulses_are_those_of_a_plain_loop():
    rng = np.random.default_rng(1)
    windows, times = pulses(rng, 90)
    edges = np.array([400.0, 900.0, 1500.0])
    times[:3] = [np.nan, 399.0, 1501.0]
    times[3] = 1500.0  # the last edge is included
    windows[4], times[4] = 0.0, 600.0
    found = superpulses(windows, times, edges)
    assert found.left_out["no_time"] == 1
    assert found.left_out["outside"] == 1 + sum((times < 400) | (times > 1500)) - 1
    assert found.left_out["unaligned"] == 1
    for pulse, (low, high) in zip(found.pulses, ((400, 900), (900, 1500.01)), strict=True):
        rows = [i for i in range(90) if low <= times[i] < high and i != 4]
        aligned = align_half_maximum(windows[rows], BEFORE, AFTER).astype(float)
        assert pulse.n == len(rows)
        np.testing.assert_allclose(pulse.mean, aligned.mean(axis=0), atol=1e-6)
        expected = aligned.std(axis=0, ddof=1) / np.sqrt(len(rows))
        np.testing.assert_allclose(pulse.error, expected, atol=1e-6)
    assert sum(p.n for p in found.pulses) + sum(found.left_out.values()) == 90


def test_without_a_difference_z_is_that_of_chance():
    rng = np.random.default_rng(2)
    edges = np.linspace(20, 120, 4) * DT
    sets = [
        slice_table({"data": drawn(rng, 150, edges), "ren": drawn(rng, 200, edges)}, DT)[
            "slices"
        ]["ren"]
        for _ in range(60)
    ]
    rows = [row for found in sets for row in found]
    assert np.mean([row["rms_z"] ** 2 for row in rows]) == pytest.approx(1, abs=0.12)
    assert np.mean([row["mean_abs_z"] for row in rows]) == pytest.approx(0.80, abs=0.06)
    ratio = np.mean([row["rms"] ** 2 for row in rows]) / np.mean(
        [row["rms_error"] ** 2 for row in rows]
    )
    assert ratio == pytest.approx(1, abs=0.2)


def test_a_known_difference_is_found_where_it_is():
    windows, times = pulses(np.random.default_rng(3), 400, noise=1e-5)
    edges = slice_edges(times, 4)
    data = superpulses(windows, times, edges)
    other = windows.copy()
    long = times >= edges[3]
    # a step of 1 % of the height after the edge, in the slowest slice only
    other[long, 180:] += 0.01
    found = superpulses(other, times, edges)
    table = slice_table({"data": data, "ren": found}, DT)
    rows = table["slices"]["ren"]
    assert [row["rms"] for row in rows[:3]] == [0, 0, 0]
    assert rows[3]["largest"] == pytest.approx(1.0, abs=0.15)
    assert rows[3]["largest_at_ns"] > 20 * DT
    # the crossing lies at sample 150-152, and the higher maximum moves it a little
    assert rows[3]["rms"] == pytest.approx(100 * 0.01 * np.sqrt(72 / 201), rel=0.2)
    json.dumps(table, allow_nan=False)


def test_few_pulses_are_missing_with_the_reason():
    windows, times = pulses(np.random.default_rng(4), 60)
    edges = slice_edges(times, 2)
    data = superpulses(windows, times, edges)
    early, late = np.flatnonzero(times < edges[1]), np.flatnonzero(times > edges[1])
    few = np.concatenate([early[:9], late])
    method = superpulses(windows[few], times[few], edges)
    rows = slice_table({"data": data, "raw": method}, DT)["slices"]["raw"]
    assert rows[0]["missing"] == "9 pulses beside 30 measured ones (at least 10 are needed)"
    assert "missing" not in rows[1]
    assert slice_residuals(data, method)[0] is None


def test_nothing_in_a_slice_is_no_failure():
    windows, times = pulses(np.random.default_rng(5), 40)
    edges = slice_edges(times, 2)
    data = superpulses(windows, times, edges)
    none = superpulses(windows, times + 1e6, edges)
    table = slice_table({"data": data, "raw": none}, DT)
    assert table["left_out"]["raw"]["outside"] == 40
    assert all(row["n"] == 0 and "missing" in row for row in table["slices"]["raw"])
    require_drawn(slice_figure({"data": data, "raw": none}, DT, "SEP"))


def test_the_figure_has_a_column_for_each_slice():
    rng = np.random.default_rng(7)
    edges = np.linspace(20, 120, 5) * DT
    sets = {"data": drawn(rng, 100, edges), "ren": drawn(rng, 120, edges, width=6.0)}
    figure = slice_figure(sets, DT, "SEP")
    require_drawn(figure)
    assert len(figure.axes) == 8
    shown = figure.axes[4].lines[0].get_ydata()
    expected = 100 * slice_residuals(sets["data"], sets["ren"])[0].difference
    np.testing.assert_allclose(shown, expected)
