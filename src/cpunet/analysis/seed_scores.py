"""Table of the scores of trainings that differ in their seed, with the number of failures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.analysis.verdicts import number, part

Metrics = Mapping[str, Any]
Values = npt.NDArray[np.float64]

FAILED = 0.9  # of the median: a training below it has failed
WORST = 0.05  # quantile


def seed_table(metrics: Mapping[int, Metrics]) -> list[dict[str, Any]]:
    """Median, worst 5 % and failures by peak and score.

    Parameters
    ----------
    metrics
        Content of ``metrics.json`` by seed.

    Returns
    -------
    list of dict
        ``peak``, ``score`` (a parameter, scored by its IoU in percent, or ``"auc"`` and
        ``"edge_rmse"``, for which small is good), ``median``, ``worst`` (the 5 % or 95 %
        quantile), ``failures`` (number of seeds whose IoU is below 0.9 of the median or
        missing; None for the other scores), ``ceiling``.
    """
    rows = []
    for peak, parameter, ious in _compared(metrics):
        values, middle = _values(ious, "ren"), _median(ious, "ren")
        known = values[np.isfinite(values)]
        rows.append(
            {
                "peak": peak,
                "score": parameter,
                "median": middle,
                "worst": float(np.quantile(known, WORST)) if known.size else None,
                "failures": int((~(values >= FAILED * middle)).sum()),
                "ceiling": _median(ious, "ceiling"),
            }
        )
    return [*rows, *_small_is_good(metrics)]


def failed_seeds(metrics: Mapping[int, Metrics]) -> dict[int, list[str]]:
    """Scores below 0.9 of the median, or missing, by seed, such as ``"SEP drift_time"``."""
    poor: dict[int, list[str]] = {}
    for peak, parameter, ious in _compared(metrics):
        limit = FAILED * _median(ious, "ren")
        for seed, value in zip(metrics, _values(ious, "ren"), strict=True):
            if not value >= limit:
                poor.setdefault(seed, []).append(f"{peak} {parameter}")
    return poor


def scored(runs: Iterable[Metrics]) -> list[tuple[str, str]]:
    """Every peak and parameter that any of the runs has scored."""
    return list(
        dict.fromkeys(
            (peak, parameter)
            for metrics in runs
            for peak in part(metrics, "peaks")
            for parameter in part(metrics, "peaks", peak, "parameters")
        )
    )


def _compared(metrics: Mapping[int, Metrics]) -> Iterator[tuple[str, str, list[Metrics]]]:
    """The IoU of all seeds, for each peak and parameter that any seed has."""
    for peak, parameter in scored(metrics.values()):
        path = ("peaks", peak, "parameters", parameter, "iou")
        yield peak, parameter, [part(of_seed, *path) for of_seed in metrics.values()]


def _small_is_good(metrics: Mapping[int, Metrics]) -> Iterator[dict[str, Any]]:
    paths = {"auc": ("two_sample", "ren", "auc"), "edge_rmse": ("paired", "ren", "edge_rmse")}
    peaks = dict.fromkeys(peak for of_seed in metrics.values() for peak in of_seed["peaks"])
    for peak in peaks:
        for name, path in paths.items():
            found = [number(of_seed, "peaks", peak, *path) for of_seed in metrics.values()]
            known = [value for value in found if value is not None]
            if known:
                yield {
                    "peak": peak,
                    "score": name,
                    "median": float(np.median(known)),
                    "worst": float(np.quantile(known, 1 - WORST)),
                    "failures": None,
                    "ceiling": None,
                }


def _values(ious: list[Metrics], method: str) -> Values:
    return np.array([number(iou, method) for iou in ious], float)  # None becomes NaN


def _median(ious: list[Metrics], method: str) -> float:
    values = _values(ious, method)
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")
