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


def correlations(chain: DescribedChain) -> tuple[list[str], Values]:
    """Names of the numbers of a chain that its fit determines, and their correlations."""
    run, fit = chain.run, chain.run.fit
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
    names = [
        n for n in chain.errors if chain.errors[n] and all(n in e for p in ends for e in p)
    ]
    moved = np.array([[0.5 * (a[n] - b[n]) for n in names] for a, b in ends])
    moved = moved.reshape(len(ends), len(names))
    sizes = np.sqrt((moved**2).sum(axis=0))
    names = [name for name, size in zip(names, sizes, strict=True) if size > 0]
    moved, sizes = moved[:, sizes > 0], sizes[sizes > 0]
    return names, (moved.T @ moved) / np.outer(sizes, sizes)


def as_yaml(chains: Mapping[str, DescribedChain]) -> str:
    """Value and error of each number, and correlations, by channel."""
    content = {}
    for name, chain in chains.items():
        names, matrix = correlations(chain)
        content[name] = {
            "run": chain.run.name,
            "good": chain.run.ok,
            "numbers": {
                n: {"value": v, "error": chain.errors.get(n)} for n, v in chain.values.items()
            },
            "correlations": {"names": names, "matrix": matrix.round(4).tolist()},
        }
    return yaml_text(plain(content))


def as_csv(chains: Mapping[str, DescribedChain]) -> str:
    """A line for each channel: each number with its error."""
    names = list(dict.fromkeys(n for chain in chains.values() for n in chain.values))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    columns = [f"{name}{end}" for name in names for end in ("", "_error")]
    writer.writerow(["channel", "good", *columns])
    for channel, chain in chains.items():
        cells = [of.get(n, "") for n in names for of in (chain.values, chain.errors)]
        writer.writerow([channel, int(chain.run.ok), *cells])
    return stream.getvalue()


def outliers(values: Sequence[float | None], errors: Sequence[float | None]) -> list[bool]:
    """Which values are far from the median, in robust standard deviations and in errors.

    Examples
    --------
    >>> outliers([1.0, 1.1, 0.9, 1.0, 1.05, 3.0], [0.01] * 6)
    [False, False, False, False, False, True]
    """
    numbers = np.array([np.nan if value is None else value for value in values], float)
    own = np.array([error or 0.0 for error in errors])
    finite = numbers[np.isfinite(numbers)]
    if finite.size < FEW:
        return [False] * len(numbers)
    spread = np.hypot(median_abs_deviation(finite, scale="normal"), own)
    distances = np.abs(numbers - np.median(finite))
    return [bool(a > FAR * s) for a, s in zip(distances, spread, strict=True)]


def array_page(chains: Mapping[str, DescribedChain]) -> str:
    """A page of all channels, on which outliers and bad fits are marked."""
    from cpunet.html_pages import rendered
    from cpunet.tables import with_std

    columns: dict[str, list[tuple[str, bool]]] = {}
    for name, title in SHOWN.items():
        values = [chain.values.get(name) for chain in chains.values()]
        errors = [chain.errors.get(name) for chain in chains.values()]
        if any(value is not None for value in values):
            texts = [with_std(v, e) for v, e in zip(values, errors, strict=True)]
            columns[title] = list(zip(texts, outliers(values, errors), strict=True))
    rows: list[dict[str, Any]] = []
    for i, (channel, chain) in enumerate(chains.items()):
        cells = [column[i] for column in columns.values()]
        marked = sum(far for _, far in cells) + (not chain.run.ok)
        rows.append({"name": channel, "good": chain.run.ok, "cells": cells, "marked": marked})
    rows.sort(key=lambda row: -row["marked"])
    marked = sum(bool(row["marked"]) for row in rows)
    title = f"Readouts of {len(rows)} channels: {marked} to look at"
    return rendered("array.html", title=title, head=list(columns), rows=rows, far=f"{FAR:g}")
