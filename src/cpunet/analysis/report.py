"""The validation's outcome as files: ``metrics.json``, figures, one page to read.

The page needs nothing but itself: figures are embedded, and no request leaves it.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cpunet.analysis.style import label
from cpunet.pulses.parameters import PARAMETERS

METRICS = "metrics.json"
DPI = 150
WIDE = 2.0  # a figure this many times wider than high takes the whole width of the page
NO_VALUE = "–"


def write_report(
    folder: Path,
    metrics: Mapping[str, Any],
    figures: Mapping[str, Figure],
    notes: Sequence[str],
) -> None:
    """Write ``metrics.json``, a PNG per figure and ``report.html`` into a folder.

    Parameters
    ----------
    folder
        An existing folder, see `files.folder_written_aside`.
    metrics
        ``peaks``: by peak, ``n_sim``, ``n_data``, ``not_prepared`` (counts by method),
        ``parameters`` (the result of `comparisons.compare`), ``two_sample`` (the classifier
        test by method) and, if the truth is known, ``paired`` (by method, the
        result of `paired.paired_scores`), or ``missing``: why it is not scored;
        ``training``: how the network was trained; ``rejections``: counts by reason,
        possibly nested.  Numbers that are not finite are written as ``null``.
    figures
        Figures by name; the names become file names and captions.
    notes
        Paragraphs of plain text for the top of the page.
    """
    metrics = _json_ready(metrics)
    text = json.dumps(metrics, indent=2, sort_keys=True, allow_nan=False, ensure_ascii=False)
    (folder / METRICS).write_text(text + "\n", encoding="utf-8")
    drawn = []
    for name, figure in figures.items():
        png = _png(figure)
        (folder / f"{_file_stem(name)}.png").write_bytes(png)
        drawn.append(_figure_html(name, figure, png))
    page = Template(files("cpunet.analysis").joinpath("report.html").read_text("utf-8"))
    html = page.substitute(
        notes="\n".join(f"<p>{escape(note)}</p>" for note in notes),
        scores="\n".join(_peak_html(n, p) for n, p in metrics.get("peaks", {}).items()),
        survival=_survival_html(metrics.get("ae_survival", {})),
        figures="\n".join(drawn),
        rejections=_pairs_table(metrics.get("rejections", {}), ("Reason", "Pulses")),
        training=_pairs_table(metrics.get("training", {}), ("Setting", "Value")),
    )
    (folder / "report.html").write_text(html, encoding="utf-8")


def _peak_html(peak: str, scores: Mapping[str, Any]) -> str:
    """One peak: its numbers of events and its two tables."""
    parts = [
        f"<h3>{escape(peak)}: {_number(scores.get('n_sim'))} simulated, "
        f"{_number(scores.get('n_data'))} measured pulses</h3>",
        f"<p>Not scored: {escape(scores['missing'])}.</p>"
        if "missing" in scores
        else _parameter_table(scores.get("parameters", {})),
    ]
    if scores.get("not_prepared"):
        counts = (f"{label(m)}: {n}" for m, n in scores["not_prepared"].items())
        parts.append(
            "<p>Simulated pulses left out because they cannot be prepared as data are once "
            f"they are translated: {escape('; '.join(counts))}.</p>"
        )
    if scores.get("two_sample"):
        parts.append(_two_sample_table(scores["two_sample"]))
    if scores.get("paired"):
        parts.append(_paired_table(scores["paired"]))
    return "\n".join(parts)


def _parameter_table(parameters: Mapping[str, Any]) -> str:
    """One row per parameter and method, and one with the ceiling."""
    rows = []
    for name, values in parameters.items():
        unit = PARAMETERS[name].unit if name in PARAMETERS else ""
        iou, error = values["iou"], values.get("iou_std", {})
        title = name.replace("_", " ").capitalize()
        for method, distance in values["wasserstein"].items():
            rows.append(
                [
                    title,
                    label(method),
                    _percent(iou.get(method), error.get(method)),
                    f"{_number(distance)} {unit}",
                    _number(values["ks"].get(method)),
                ]
            )
            title = ""
        ceiling = _percent(iou.get("ceiling"), error.get("ceiling"))
        rows.append([title, "Ceiling", ceiling, "", ""])
    return _table(["Parameter", "Method", "IoU [%]", "W₁", "KS"], rows, names=2)


def _two_sample_table(tested: Mapping[str, Mapping[str, Any]]) -> str:
    head = ["Told from data by a classifier", "AUC", "Same with shuffled labels"]
    rows = []
    for method, found in tested.items():
        if "missing" in found:
            rows.append([label(method), NO_VALUE, found["missing"]])
        else:
            null = f"{_number(found['null_mean'])} ± {_number(found['null_std'])}"
            auc = f"{_number(found['auc'])} ± {_number(found['auc_std'])}"
            rows.append([label(method), auc, null])
    return _table(head, rows)


def _survival_html(survival: Mapping[str, Any]) -> str:
    """Survival of A/E cuts by peak and method."""
    if not survival:
        return "<p>None recorded.</p>"
    if "missing" in survival:
        return f"<p>Not scored: {escape(survival['missing'])}.</p>"
    rows = []
    for peak, found in survival.items():
        for method, value in found.get("survival", {}).items():
            rows.append(
                [
                    peak,
                    label(method),
                    _percent(value, found["survival_std"].get(method)),
                    _percent(
                        found["difference"].get(method), found["difference_std"].get(method)
                    ),
                    _number(found["sigma"].get(method)),
                ]
            )
    head = ["Peak", "Method", "Survival [%]", "Less data [points]", "In sigma"]
    return _table(head, rows, names=2)


def _paired_table(paired: Mapping[str, Mapping[str, float | None]]) -> str:
    head = ["Against the true shapes", "RMSE", "RMSE of the edge"]
    rows = [
        [label(method), _number(scores.get("rmse")), _number(scores.get("edge_rmse"))]
        for method, scores in paired.items()
    ]
    return _table(head, rows)


def _pairs_table(values: Mapping[str, Any], head: tuple[str, str]) -> str:
    """Names and values; nested names are joined: ``data: saturated``."""
    rows = [[name, _number(value)] for name, value in _flat(values)]
    return _table(list(head), rows) if rows else "<p>None recorded.</p>"


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in values.items():
        nested = isinstance(value, Mapping)
        rows += _flat(value, f"{prefix}{name}: ") if nested else [(f"{prefix}{name}", value)]
    return rows


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], names: int = 1) -> str:
    """A table whose first columns, as many as `names`, hold words, the others numbers."""
    # the page aligns numbers, and the first column already as words
    styles = ["", *[' style="text-align: left"'] * (names - 1), *[""] * (len(head) - names)]

    def cells(tag: str, row: Sequence[str], attribute: str = "") -> str:
        return "".join(
            f"<{tag}{attribute}{style}>{escape(cell)}</{tag}>"
            for cell, style in zip(row, styles, strict=True)
        )

    top = cells("th", head, ' scope="col"')
    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return (
        f'<div class="scroll"><table>\n<thead><tr>{top}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody>\n</table></div>"
    )


def _figure_html(name: str, figure: Figure, png: bytes) -> str:
    width, height = figure.get_size_inches()
    caption = escape(name.replace("_", " "))
    data = base64.b64encode(png).decode("ascii")
    kind = ' class="wide"' if width >= WIDE * height else ""
    return (
        f'<figure{kind}><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    # without the program's name and version the same figure gives the same file
    figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
    return stream.getvalue()


def _file_stem(name: str) -> str:
    """The figure's name with what file systems may refuse replaced."""
    return re.sub(r"[^\w.-]+", "_", name)


def _json_ready(value: Any) -> Any:
    """Plain Python all through, with ``None`` for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): _json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json_ready(item) for item in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return _json_ready(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _number(value: Any) -> str:
    """A value as the page shows it: four digits are enough to compare two scores."""
    if value is None:
        return NO_VALUE
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _percent(value: float | None, error: float | None) -> str:
    if value is None:
        return NO_VALUE
    return f"{value:.1f}" if error is None else f"{value:.1f} ± {error:.1f}"
