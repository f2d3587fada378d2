"""Table of the scores of trainings that differ in their seed, with the number of failures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

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


def _compared(
    metrics: Mapping[int, Metrics],
) -> Iterator[tuple[str, str, list[Mapping[str, Any]]]]:
    """The IoU of all seeds, for each peak and parameter that any seed has."""
    places = dict.fromkeys(
        (peak, parameter)
        for of_seed in metrics.values()
        for peak, scores in of_seed["peaks"].items()
        for parameter in scores["parameters"]
    )
    for peak, parameter in places:
        path = ("peaks", peak, "parameters", parameter, "iou")
        yield peak, parameter, [_part(of_seed, path) or {} for of_seed in metrics.values()]


def _small_is_good(metrics: Mapping[int, Metrics]) -> Iterator[dict[str, Any]]:
    parts = {"auc": ("two_sample", "ren", "auc"), "edge_rmse": ("paired", "ren", "edge_rmse")}
    peaks = dict.fromkeys(peak for of_seed in metrics.values() for peak in of_seed["peaks"])
    for peak in peaks:
        for name, path in parts.items():
            found = [_part(of_seed["peaks"].get(peak), path) for of_seed in metrics.values()]
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


def _part(content: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        content = content.get(key) if isinstance(content, Mapping) else None
    return content


def _values(ious: list[Mapping[str, Any]], method: str) -> Values:
    return np.array([iou.get(method) for iou in ious], float)  # None becomes NaN


def _median(ious: list[Mapping[str, Any]], method: str) -> float:
    values = _values(ious, method)
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")
