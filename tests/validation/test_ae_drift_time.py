"""A/E against the drift time, against plain counting and analytic quantiles."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.special import ndtri

from cpunet.validation.ae_drift_time import ae_against_drift_time, ae_figure
from cpunet.validation.run_figures import roc_figure
from synthetic import require_drawn


def events(rng, n, slope=-1e-5):
    """A/E that falls with the drift time, with a Gaussian spread."""
    time = rng.uniform(500, 1500, n)
    return 0.07 + slope * (time - 1000) + rng.normal(0, 0.002, n), time


def by_method(rng, sizes, **kwargs):
    drawn = {m: events(rng, n, **kwargs) for m, n in sizes.items()}
    return {m: a for m, (a, _) in drawn.items()}, {m: t for m, (_, t) in drawn.items()}


def test_quantiles_are_the_analytic_ones():
    amplitude, time = by_method(
        np.random.default_rng(0), {"data": 80_000, "ren": 80_000}, slope=0
    )
    table = ae_against_drift_time(amplitude, time, bins=4)
    assert table["edges_ns"][1:-1] == pytest.approx([750, 1000, 1250], abs=8)
    for row in table["methods"]["ren"]:
        for name, p in (("q16", 0.16), ("median", 0.5), ("q84", 0.84)):
            assert row[name] == pytest.approx(0.07 + 0.002 * ndtri(p), abs=6e-5)
        # the error of a median of normal values
        assert row["median_error"] == pytest.approx(
            0.002 * np.sqrt(np.pi / 2 / row["n"]), rel=0.2
        )
    json.dumps(table, allow_nan=False)


@pytest.mark.parametrize("n", [15, 200])
def test_errors_are_the_spread_over_repeated_draws(n):
    rng = np.random.default_rng(1)
    rows = []
    for _ in range(400):
        amplitude, time = by_method(rng, {"data": n}, slope=0)
        rows.append(ae_against_drift_time(amplitude, time, bins=1)["methods"]["data"][0])
    for name in ("q16", "median", "q84"):
        spread = np.std([row[name] for row in rows])
        assert np.mean([row[f"{name}_error"] for row in rows]) == pytest.approx(spread, rel=0.2)


def test_bins_are_those_of_a_plain_loop_and_what_is_outside_is_counted():
    amplitude, time = by_method(np.random.default_rng(2), {"data": 300, "raw": 60})
    time["raw"][:2] = [1e4, np.nan]
    amplitude["raw"][2] = np.nan
    table = ae_against_drift_time(amplitude, time, bins=3)
    edges = table["edges_ns"]
    assert table["left_out"]["data"] == 0
    assert table["left_out"]["raw"] >= 3
    rows = table["methods"]["raw"]
    assert sum(row["n"] for row in rows) + table["left_out"]["raw"] == 60
    inside = [
        a
        for a, t in zip(amplitude["raw"], time["raw"], strict=True)
        if edges[1] <= t < edges[2] and np.isfinite(a)
    ]
    assert rows[1]["n"] == len(inside)
    assert rows[1]["median"] == np.median(inside)


def test_a_bin_with_few_events_is_missing():
    amplitude, time = by_method(np.random.default_rng(3), {"data": 100, "raw": 9})
    table = ae_against_drift_time(amplitude, time, bins=1)
    assert "(at least 10 are needed)" in table["methods"]["raw"][0]["missing"]
    require_drawn(ae_figure(table, "SEP"))


def test_figures_draw_what_is_in_the_tables():
    amplitude, time = by_method(np.random.default_rng(9), {"data": 900, "raw": 900, "ren": 900})
    table = ae_against_drift_time(amplitude, time)
    figure = ae_figure(table, "SEP")
    require_drawn(figure)
    drawn = figure.axes[0].lines[0].get_ydata()
    assert drawn.tolist() == [row["median"] for row in table["methods"]["data"]]


def test_curves_of_survival_are_the_analytic_ones():
    """Of uniform amplitudes a cut that leaves a part p of one leaves 2 p - 1 of the other."""
    single, other = np.linspace(1, 3, 2001), np.linspace(0, 2, 2001)
    unknown = np.append(other, np.nan)
    drawn = roc_figure(
        {"SEP": {"data": unknown, "ren": other}, "DEP": dict.fromkeys(("data", "ren"), single)}
    )
    (axes,) = drawn.axes
    assert [line.get_label() for line in axes.lines] == ["Data", "REN translation"]
    for line in axes.lines:
        accepted, left = line.get_data()
        assert left == pytest.approx(np.clip(2 * accepted - 100, 0, 100) / 2, abs=0.2)
