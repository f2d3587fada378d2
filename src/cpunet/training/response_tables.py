"""Readouts of many channels and runs as tables: values, errors, correlations, outliers."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import median_abs_deviation

from cpunet.networks.generators import ResponseGenerator
from cpunet.recipes.schema import ResponseConfig
from cpunet.settings import plain, yaml_text
from cpunet.training.aligned import Values
from cpunet.training.chain_description import DescribedChain
from cpunet.training.closed_forms import chain_numbers, error_ends, learned_chain

# What a page of channels shows, and where a channel stands out: so many robust standard
# deviations from the median, of at least so many channels.
SHOWN = {
    "rise_10_90_ns": "rise 10–90 % [ns]",
    "slow_share": "late charge",
    "missing_500_ns": "not yet collected after 500 ns",
    "effective_decay_us": "effective decay [µs]",
    "noise_rms_kev": "noise RMS [keV]",
    "chi_square_per_moment": "chi-square per moment",
}
FAR, FEW = 4.0, 5


def correlations(one: DescribedChain) -> tuple[list[str], Values]:
    """Names of the numbers of a chain that its fit determines, and their correlations."""
    run, fit = one.run, one.run.fit
    if fit is None or not isinstance(run.recipe.generator, ResponseConfig):
        return [], np.zeros((0, 0))
    generator = run.fill("ren", ResponseGenerator(run.recipe.generator, run.dt_ns))
    ends = [
        [
            chain_numbers(learned_chain(end, ""), run.recipe.preparation, run.dt_ns)
            for end in pair
        ]
        for pair in error_ends(generator.response, fit.covariance)
    ]
    known = [n for n in one.errors if one.errors[n] and all(n in e for p in ends for e in p)]
    moved = np.array([[0.5 * (a[n] - b[n]) for n in known] for a, b in ends])
    moved = moved.reshape(len(ends), len(known))
    sizes = np.sqrt((moved**2).sum(axis=0))
    known = [name for name, size in zip(known, sizes, strict=True) if size > 0]
    moved, sizes = moved[:, sizes > 0], sizes[sizes > 0]
    return known, (moved.T @ moved) / np.outer(sizes, sizes)


def as_yaml(chains: Mapping[str, DescribedChain]) -> str:
    """Value and error of each number, and correlations, by channel."""
    content = {}
    for name, one in chains.items():
        names, matrix = correlations(one)
        content[name] = {
            "run": one.run.name,
            "good": one.run.ok,
            "numbers": {
                n: {"value": v, "error": one.errors.get(n)} for n, v in one.values.items()
            },
            "correlations": {"names": names, "matrix": matrix.round(4).tolist()},
        }
    return yaml_text(plain(content))


def as_csv(chains: Mapping[str, DescribedChain]) -> str:
    """A line for each channel: each number with its error."""
    names = list(dict.fromkeys(n for one in chains.values() for n in one.values))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    columns = [f"{name}{end}" for name in names for end in ("", "_error")]
    writer.writerow(["channel", "good", *columns])
    for channel, one in chains.items():
        cells = [of.get(n, "") for n in names for of in (one.values, one.errors)]
        writer.writerow([channel, int(one.run.ok), *cells])
    return stream.getvalue()


def outliers(values: Sequence[float | None], errors: Sequence[float | None]) -> list[bool]:
    """Which values are far from the median, in robust standard deviations and in errors.

    Examples
    --------
    >>> outliers([1.0, 1.1, 0.9, 1.0, 1.05, 3.0], [0.01] * 6)
    [False, False, False, False, False, True]
    """
    found = np.array([np.nan if value is None else value for value in values], float)
    own = np.array([error or 0.0 for error in errors])
    known = found[np.isfinite(found)]
    if known.size < FEW:
        return [False] * len(found)
    spread = np.hypot(median_abs_deviation(known, scale="normal"), own)
    apart = np.abs(found - np.median(known))
    return [bool(a > FAR * s) for a, s in zip(apart, spread, strict=True)]


def array_page(chains: Mapping[str, DescribedChain]) -> str:
    """A page of all channels, on which outliers and bad fits are marked."""
    from cpunet.html_pages import rendered
    from cpunet.tables import with_std

    columns: dict[str, list[tuple[str, bool]]] = {}
    for name, title in SHOWN.items():
        values = [one.values.get(name) for one in chains.values()]
        errors = [one.errors.get(name) for one in chains.values()]
        if any(value is not None for value in values):
            texts = [with_std(v, e) for v, e in zip(values, errors, strict=True)]
            columns[title] = list(zip(texts, outliers(values, errors), strict=True))
    rows: list[dict[str, Any]] = []
    for i, (channel, one) in enumerate(chains.items()):
        cells = [column[i] for column in columns.values()]
        marked = sum(far for _, far in cells) + (not one.run.ok)
        rows.append({"name": channel, "good": one.run.ok, "cells": cells, "marked": marked})
    rows.sort(key=lambda row: -row["marked"])
    marked = sum(bool(row["marked"]) for row in rows)
    title = f"Readouts of {len(rows)} channels: {marked} to look at"
    return rendered("array.html", title=title, head=list(columns), rows=rows, far=f"{FAR:g}")
