"""Readouts of many channels and runs as tables: values, errors, correlations, outliers."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import median_abs_deviation

from cpunet.settings import plain, yaml_text
from cpunet.training.chain_description import DescribedChain

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


def as_yaml(chains: Mapping[str, DescribedChain]) -> str:
    """Value and error of each number, and correlations, by channel."""
    content = {}
    for name, chain in chains.items():
        names = [name for name in chain.moved if chain.errors.get(name)]
        moved = np.array([chain.moved[name] for name in names])  # (numbers, axes)
        covariance = moved @ moved.T if names else np.zeros((0, 0))
        sizes = np.sqrt(covariance.diagonal())
        content[name] = {
            "run": chain.run.name,
            "good": chain.run.ok,
            "numbers": {
                n: {"value": v, "error": chain.errors.get(n)} for n, v in chain.values.items()
            },
            "correlations": {
                "names": names,
                "matrix": (covariance / np.outer(sizes, sizes)).round(4).tolist(),
            },
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
