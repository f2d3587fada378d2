"""Pulses and views of three made-up methods, for tests of the report's page."""

from __future__ import annotations

from typing import Any

import numpy as np

from cpunet.analysis.chart_data import (
    distributions,
    method_looks,
    pulse_views,
    scatter_views,
    superpulse_views,
)
from cpunet.analysis.comparisons import compare
from cpunet.recipes import load_recipe

DT_NS = 16.0
EVENTS = 300
# rise in samples, its shift, and the noise of each method
METHODS = {
    "data": (9.0, 0.0, 0.004),
    "raw": (5.0, 0.0, 0.0),
    "gauss_exp": (10.0, 0.0, 0.004),
    "ren": (9.1, 0.0, 0.004),
    "ren_no_noise": (9.1, 0.0, 0.0),
    "truth": (9.0, 0.0, 0.004),
}
SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 10})


def windows(rise: float, noise: float, n: int, seed: int) -> np.ndarray:
    """Pulses of 800 samples: two steps of charge and a decay."""
    rng = np.random.default_rng(seed)
    share, late = rng.uniform(0.3, 1.0, (2, n, 1))
    sites = np.random.default_rng(seed + 1)
    time = np.arange(800.0) - 370
    one = 1 / (1 + np.exp(-time / rise * 3))
    two = 1 / (1 + np.exp(-(time - 25 * late) / rise * 3))
    decay = np.exp(-np.maximum(time, 0) / 3400)
    pulses = (share * one + (1 - share) * two) * decay
    return (pulses + sites.normal(0, noise, (n, 800)) if noise else pulses).astype(np.float32)


def parameters(rise: float, n: int, seed: int, more: int = 0) -> dict[str, np.ndarray]:
    """Values of a few parameters as a method with this rise would have them."""
    rng = np.random.default_rng(seed)
    time = rng.gamma(30, 30, n) + 40 * rise
    values = {
        "current_amplitude": 0.6 / rise + rng.normal(0, 0.001, n) - 0.02 * rng.random(n) ** 6,
        "drift_time": np.where(rng.random(n) < 0.01, np.nan, time),
        "tail_slope": rng.normal(-18.4, 0.3, n),
    }
    return values | {f"further_{i}": rng.normal(i + rise / 90, 1, n) for i in range(more)}


def values_of(n: int = EVENTS, more: int = 1) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """Parameters by peak, method and name; the DEP has none."""
    by_method = {
        m: parameters(r, n, i, more) for i, (m, (r, _, _)) in enumerate(METHODS.items())
    }
    return {"SEP": by_method, "FEP": by_method, "DEP": {}}


def scores_of(values: dict[str, dict[str, dict[str, np.ndarray]]]) -> dict[str, Any]:
    """Result of `compare` by peak."""
    return {
        peak: compare(m["data"], {k: v for k, v in m.items() if k != "data"}, SCORES, seed=1)
        for peak, m in values.items()
        if m
    }


def superpulses(slices: int, samples: int = 400) -> dict[str, dict[str, dict[str, Any]]]:
    """Mean pulses of a peak with data, and of one without."""
    found = {}
    for method, (rise, _, _) in METHODS.items():
        pulses = windows(rise, 0, slices, seed=4)[:, 210 : 210 + samples]
        error = np.full(pulses.shape, 5e-4) * (1 + 3 * pulses * (1 - pulses))
        noise = np.random.default_rng(len(method)).normal(0, 2e-4, pulses.shape)
        found[method] = {"n": [75] * slices, "mean": pulses + noise, "error": error}
    # the last slice has a single measured pulse
    found["data"]["n"][-1] = 1
    found["data"]["mean"][-1] = found["data"]["error"][-1] = np.nan
    return {"SEP": found, "DEP": {}}


def views_of(n: int = EVENTS, more: int = 1) -> dict[str, Any]:
    """All that the page can show."""
    values = values_of(n, more)
    clean = {m: windows(r, 0, 60, seed=7) for m, (r, _, _) in METHODS.items() if m != "data"}
    measured = windows(9.0, 0.004, 400, seed=8)
    labels = [f"{low} … {low + 200} ns" for low in (600, 800, 1000, 1200)]
    return {
        "methods": method_looks(METHODS),
        "distributions": distributions(values, scores_of(values)),
        "slices": superpulse_views(superpulses(len(labels)), {"SEP": labels}, DT_NS),
        "pulses": pulse_views({"SEP": clean, "DEP": {}}, DT_NS, {"SEP": measured}),
        "scatter": scatter_views(values),
    }
