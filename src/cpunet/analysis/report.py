"""Results of a validation as files: ``metrics.json``, figures and an HTML page.

The page is self-contained: figures, data and script are embedded, and its content security
policy blocks all requests.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from cpunet.analysis.ae_energy_figure import FIGURE as AE_ENERGY
from cpunet.analysis.ae_energy_figure import ae_energy_html
from cpunet.analysis.html_pages import (
    figure_html,
    figure_png,
    joined,
    part,
    rendered,
    script,
)
from cpunet.analysis.nested_tables import nested_html, number
from cpunet.analysis.report_folder import METRICS
from cpunet.analysis.report_tables import (
    pairs_table,
    peak_html,
    survival_html,
    verdicts_html,
)

FIRST = 2  # figures of mean pulses at the top of the page
MANY = 4  # number of figures from which they are collapsed

SCRIPTS = ("marks", "plot", "legend", "distributions", "pulses", "scatter", "start")

# titles and descriptions of the interactive views
VIEWS = {
    "distributions": (
        "Parameter distributions",
        "In the bins in which they are scored, with the data's statistical errors; below, the "
        "pull of each bin: method less data in standard deviations of both. The frame is "
        "fitted without the raw simulation's points. The IoU beside the data is the ceiling.",
    ),
    "slices": (
        "Mean pulses by rise time",
        "Pulses aligned at half maximum and averaged within slices of rise time, 1 to 90 %; "
        "below, the differences from the data's, with the standard error of each mean as a "
        "band and that of the data in grey about zero. Errors of neighbouring samples are "
        "correlated.",
    ),
    "pulses": (
        "Single pulses by every method",
        "The same simulated event by every method, without noise, aligned at half maximum.",
    ),
    "scatter": (
        "Current amplitude and drift time",
        "One point a pulse, data in grey and one method beside them; of larger sets a part, "
        "drawn at random. The drift time ends at the maximum, which on a flat top is that of "
        "the noise.",
    ),
}
# parts of the metrics that are shown as nested tables
DETAILS = {
    "ae_details": "A/E in detail",
    "drift_slices": "Slices of rise time, 1 to 90 %",
    "linearity": "Linearity",
    "noise": "Noise",
}


def write_report(
    folder: Path,
    metrics: Mapping[str, Any],
    figures: Mapping[str, Figure],
    notes: Sequence[str],
    views: Mapping[str, Any] | None = None,
) -> None:
    """Write ``metrics.json``, a PNG per figure and ``report.html`` into a folder.

    Parameters
    ----------
    folder
        An existing folder, see `files.folder_written_aside`.
    metrics
        ``peaks``: by peak, ``n_sim``, ``n_data``, ``not_prepared`` (counts by method),
        ``parameters`` (result of `comparisons.compare`), ``two_sample`` (classifier test by
        method) and, if the truth is known, ``paired`` (result of `paired.paired_scores` by
        method); or ``missing`` with the reason why the peak is not scored.
        ``verdicts``: ``summary``, a list of sentences, and ``table`` with ``sigma`` and
        ``words`` by peak, method and quantity.  ``ae_survival``, ``ae_details``,
        ``drift_slices``, ``linearity``, ``noise``: nested values, shown as tables.
        ``compared``: names and values of the compared inputs.  ``training``: how the network
        was trained.  ``rejections``: counts by reason, possibly nested.  ``ae_energy``: result
        of `ae_energy.against_energy`.  Non-finite numbers are written as ``null``.
    figures
        Figures by name; the names become file names and captions.
    notes
        Paragraphs of plain text for the top of the page.
    views
        Data of the interactive charts from `views`: ``methods`` (see `views.method_looks`),
        ``distributions``, ``slices``, ``pulses``, ``scatter``; any of them can be missing.
        Without views the page has only its figures.
    """
    metrics = _json_ready(metrics)
    text = json.dumps(metrics, indent=2, sort_keys=True, allow_nan=False, ensure_ascii=False)
    (folder / METRICS).write_text(text + "\n", encoding="utf-8")
    drawn = {}
    for name, figure in figures.items():
        png = figure_png(figure)
        (folder / f"{_file_stem(name)}.png").write_bytes(png)
        drawn[name] = figure_html(name.replace("_", " "), figure, png)
    ae_energy = ae_energy_html(metrics.get("ae_energy", {}), drawn.pop(AE_ENERGY, Markup()))
    first, of_noise, of_ae, others = _shared_out(drawn, metrics.get("training", {}).get("peak"))
    judged = metrics.get("verdicts", {}).get("table", {})
    views = _json_ready(views or {})
    html = rendered(
        "report.html",
        title="CPU-Net validation",
        compared={name: number(v) for name, v in metrics.get("compared", {}).items()},
        first=_gallery(first),
        notes=notes,
        verdicts=verdicts_html(metrics.get("verdicts")),
        scores=joined(
            peak_html(name, scores, judged.get(name))
            for name, scores in metrics.get("peaks", {}).items()
        )
        or part("gap", "no peak was scored"),
        shapes=_views_html(views, ("distributions", "slices")),
        pulses=_views_html(views, ("pulses", "scatter")),
        survival=survival_html(metrics.get("ae_survival", {})),
        ae=_gallery(of_ae),
        ae_energy=ae_energy,
        noise=_gallery(of_noise),
        details=_details_html(metrics),
        figures=_gallery(others) or part("gap", "no figures were drawn"),
        rejections=pairs_table(metrics.get("rejections", {}), ("Reason", "Pulses")),
        training=pairs_table(metrics.get("training", {}), ("Setting", "Value")),
        script=script(views, SCRIPTS) if _drawn(views) else "",
    )
    (folder / "report.html").write_text(html, encoding="utf-8")


def _shared_out(
    drawn: Mapping[str, Markup], trained_on: str | None
) -> tuple[list[Markup], list[Markup], list[Markup], list[Markup]]:
    """Figures at the top of the page, those of noise, those of A/E cuts, and all others.

    Mean pulses come first, preferably of peaks that were not used in the training.
    """
    held_out = [name for name in drawn if not name.startswith(f"{trained_on} ")]
    chosen = {
        end: [name for name in held_out if name.endswith(end)][:FIRST]
        or [name for name in drawn if name.endswith(end)][:FIRST]
        for end in (" mean pulse", " noise", "A over E survival")
    }
    used = {name for names in chosen.values() for name in names}
    others = [html for name, html in drawn.items() if name not in used]
    first, noise, cuts = ([drawn[name] for name in names] for names in chosen.values())
    return first, noise, cuts, others


def _drawn(views: Mapping[str, Any]) -> bool:
    return any(views.get(name) for name in VIEWS)


def _views_html(views: Mapping[str, Any], names: Sequence[str]) -> Markup:
    """Elements in which the script draws, or the reason why it does not."""
    if not _drawn(views):
        return part("gap", "this report was written without the data of the interactive views")
    return joined(part("view", name, *VIEWS[name], bool(views.get(name))) for name in names)


def _details_html(metrics: Mapping[str, Any]) -> Markup:
    """Return those parts of the metrics that are shown as nested tables, if any."""
    return joined(
        part("folded", title, nested_html(metrics[name]))
        for name, title in DETAILS.items()
        if metrics.get(name)
    )


def _gallery(drawn: Sequence[Markup]) -> Markup:
    gallery = part("grid", "figures", drawn)
    if len(drawn) <= MANY:
        return gallery
    return part("folded", f"{len(drawn)} figures, also as PNG beside this page", gallery)


def _file_stem(name: str) -> str:
    """Name of the figure, with characters that file systems may refuse replaced."""
    return re.sub(r"[^\w.-]+", "_", name)


def _json_ready(value: Any) -> Any:
    """Convert to plain Python types, with ``None`` for non-finite numbers."""
    if isinstance(value, Mapping):
        return {str(key): _json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json_ready(item) for item in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return _json_ready(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
