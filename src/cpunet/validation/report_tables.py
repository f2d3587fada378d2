"""Scores as HTML tables of the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from markupsafe import Markup

from cpunet.html_pages import joined, part
from cpunet.plotting import NO_NOISE, label
from cpunet.pulses.parameters import PARAMETERS
from cpunet.pulses.shape_parameters import SHAPE_PARAMETERS
from cpunet.tables import NO_VALUE, number, with_std
from cpunet.validation.nested_tables import html_table, words_of
from cpunet.validation.score_panels import score_panels


def verdicts_html(verdicts: Mapping[str, Any] | None) -> Markup:
    """Return the verdicts in plain words; nothing without verdicts."""
    if not verdicts:
        return Markup()
    parts = []
    if verdicts.get("summary"):
        parts.append(part("points", verdicts["summary"]))
    rows = [
        [peak, label(method), words_of(quantity), _sigma(found["sigma"]), found["words"]]
        for peak, methods in verdicts.get("table", {}).items()
        for method, quantities in methods.items()
        for quantity, found in quantities.items()
    ]
    if rows:
        head = ["Peak", "Method", "Quantity", "σ", "In words"]
        table = html_table(head, rows, words={0, 1, 2, 4})
        parts.append(part("folded", "Each verdict", table, screen=True))
    return joined(parts)


def peak_html(
    peak: str, scores: Mapping[str, Any], verdicts: Mapping[str, Any] | None = None
) -> Markup:
    """Return the section of one peak: numbers of events and tables.

    `verdicts` are those of the peak by method and parameter, see `verdicts.verdict_table`.
    """
    parameters = scores.get("parameters", {})
    chief = {name: found for name, found in parameters.items() if name in PARAMETERS}
    others = {name: found for name, found in parameters.items() if name not in PARAMETERS}
    others |= scores.get("further", {})
    n_sim, n_data = (number(scores.get(name)) for name in ("n_sim", "n_data"))
    parts = [
        part("heading", 3, f"{peak}: {n_sim} simulated, {n_data} measured pulses"),
        part("p", f"Not scored: {scores['missing']}.")
        if "missing" in scores
        else score_panels(peak, scores),
    ]
    if chief:
        parts.append(
            part("folded", "Scores as a table", _parameter_table(chief, _noisy, verdicts))
        )
    if others:
        title = f"Further parameters: {len(others)}"
        table = _parameter_table(others, _noisy, verdicts)
        parts.append(part("folded", title, table, screen=True))
    if any(not _noisy(m) for found in chief.values() for m in found["wasserstein"]):
        without = _parameter_table(chief, lambda m: not _noisy(m))
        parts.append(part("folded", "Scores without noise", without, screen=True))
    if scores.get("not_prepared"):
        counts = (f"{label(m)}: {n}" for m, n in scores["not_prepared"].items())
        text = "Simulated pulses left out because, once translated, they cannot be prepared "
        parts.append(part("p", f"{text}like data: {'; '.join(counts)}."))
    tables = []
    if scores.get("two_sample"):
        title = "The classifier as a table"
        tables.append(part("folded", title, _two_sample_table(scores["two_sample"])))
    if scores.get("paired"):
        tables.append(_paired_table(scores["paired"]))
    return joined([*parts, part("grid", "beside", tables)])


def survival_html(survival: Mapping[str, Any]) -> Markup:
    """Return the survival of A/E cuts by peak and method."""
    if not survival:
        return part("p", "None recorded.")
    if "missing" in survival:
        return part("p", f"Not scored: {survival['missing']}.")
    rows = []
    for peak, found in survival.items():
        title = peak
        for method, value in found.get("survival", {}).items():
            if not _noisy(method):
                continue  # in metrics.json
            rows.append(
                [
                    title,
                    label(method),
                    _percent(value, found["survival_std"].get(method)),
                    _percent(
                        found["difference"].get(method), found["difference_std"].get(method)
                    ),
                    _sigma(found["sigma"].get(method)),
                ]
            )
            title = ""
    head = ["Peak", "Method", "Survival [%]", "Minus data [points]", "In σ"]
    return html_table(head, rows, words={0, 1})


def pairs_table(values: Mapping[str, Any], head: tuple[str, str]) -> Markup:
    """Return a table of names and values; nested names are joined: ``data: saturated``."""
    rows = [[name, number(value)] for name, value in _flat(values)]
    return html_table(list(head), rows) if rows else part("p", "None recorded.")


def _noisy(method: str) -> bool:
    return not method.endswith(NO_NOISE)


def _parameter_table(
    parameters: Mapping[str, Any],
    shown: Callable[[str], bool],
    verdicts: Mapping[str, Any] | None = None,
) -> Markup:
    """One row per parameter and shown method, and one with the ceiling."""
    rows = []
    for name, values in parameters.items():
        unit = SHAPE_PARAMETERS[name].unit if name in SHAPE_PARAMETERS else ""
        iou, error = values["iou"], values.get("iou_std", {})
        title = name.replace("_", " ").capitalize() + (f" [{unit}]" if unit else "")
        for method, distance in values["wasserstein"].items():
            if not shown(method):
                continue
            moved = with_std(distance, values.get("wasserstein_std", {}).get(method))
            apart = with_std(values["ks"].get(method), values.get("ks_std", {}).get(method))
            score = _percent(iou.get(method), error.get(method))
            words = (verdicts or {}).get(method, {}).get(name, {}).get("words", "")
            rows.append([title, label(method), score, moved, apart, words])
            title = ""
        ceiling = _percent(iou.get("ceiling"), error.get("ceiling"))
        moved, apart = (
            with_std(values[f"{kind}_null"], values.get(f"{kind}_null_std"))
            if values.get(f"{kind}_null") is not None
            else ""
            for kind in ("wasserstein", "ks")
        )
        rows.append([title, "Ceiling", ceiling, moved, apart, ""])
    head = ["Parameter", "Method", "IoU [%]", "W₁ [unit of the parameter]", "KS", "Overlap"]
    if not verdicts:
        head, rows = head[:-1], [row[:-1] for row in rows]
    return html_table(head, rows, words={0, 1, 5})


def _two_sample_table(tested: Mapping[str, Mapping[str, Any]]) -> Markup:
    head = ["Distinguished from data by a classifier", "AUC", "Same with shuffled labels"]
    rows = []
    for method, found in tested.items():
        if "missing" in found:
            rows.append([label(method), NO_VALUE, found["missing"]])
        else:
            null = with_std(found["null_mean"], found["null_std"])
            rows.append([label(method), with_std(found["auc"], found["auc_std"]), null])
    return html_table(head, rows)


def _paired_table(paired: Mapping[str, Mapping[str, float | None]]) -> Markup:
    head = ["Against the true shapes [10⁻³ of the height]", "RMSE", "RMSE of the edge"]
    rows = [
        [label(method), *(_thousandths(scores.get(key)) for key in ("rmse", "edge_rmse"))]
        for method, scores in paired.items()
    ]
    return html_table(head, rows)


def _thousandths(value: float | None) -> str:
    return NO_VALUE if value is None else f"{1e3 * value:#.3g}".rstrip(".")


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in values.items():
        nested = isinstance(value, Mapping)
        rows += _flat(value, f"{prefix}{name}: ") if nested else [(f"{prefix}{name}", value)]
    return rows


def _sigma(value: float | None) -> str:
    return NO_VALUE if value is None else f"{round(value, 1) + 0.0:+.1f}"


def _percent(value: float | None, error: float | None) -> str:
    if value is None:
        return NO_VALUE
    value = round(value, 1) + 0.0  # no negative zero
    return f"{value:.1f}" if error is None else f"{value:.1f} ± {error:.1f}"
