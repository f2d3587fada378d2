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
from cpunet.pulses.parameters import PARAMETERS

FIRST = 2  # figures of mean pulses at the top of the page, and of noise
# section of a figure by the end of its name; all others are under Details
PLACES = {
    "A over E survival": "ae",
    "A over E and drift time": "ae_drift",
    "A over E": "ae_drift",
    "mean pulse": "first",
    "superpulses": "slices",
    "noise": "noise",
    **{parameter.replace("_", " "): "distributions" for parameter in PARAMETERS},
}
MANY = 4  # a larger number of figures is collapsed

SCRIPTS = ("marks", "plot", "legend", "distributions", "pulses", "scatter", "start")

# titles and descriptions of the interactive views
VIEWS = {
    "distributions": (
        "Parameter distributions",
        "In the bins in which they are scored, with the data's statistical errors; below, the "
        "pull of each bin: method minus data, divided by the error of the difference. Pulls of "
        "the raw simulation do not set the scale. The IoU of the data is the ceiling.",
    ),
    "slices": (
        "Mean pulses by rise time",
        "Pulses aligned at half maximum and averaged within slices of rise time, 1 to 90 %; "
        "below, the differences from the data, with the standard error of each mean as a band "
        "and that of the data in grey about zero. Errors of neighbouring samples are "
        "correlated.",
    ),
    "pulses": (
        "Single pulses by every method",
        "The same simulated event by every method, without noise, aligned at half maximum.",
    ),
    "scatter": (
        "Current amplitude and drift time",
        "One point per pulse, the data in grey and one method beside them; of larger sets, a "
        "random sample. The drift time ends at the maximum, which on a flat top is that of the "
        "noise.",
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
        method) and, if the truth is known, ``paired`` (result of `paired.scores_of_squares` by
        method); or ``missing`` with the reason why the peak is not scored.
        ``verdicts``: ``summary``, a list of sentences, and ``table``, see
        `verdicts.verdict_table`.  ``ae_survival``, ``ae_details``,
        ``drift_slices``, ``linearity``, ``noise``: nested values, shown as tables.
        ``compared``: names and values of the compared inputs.  ``training``: how the network
        was trained.  ``rejections``: counts by reason, possibly nested.  ``ae_energy``: result
        of `ae_energy.against_energy`.  Non-finite numbers are written as ``null``.
    figures
        Figures by name; the names become file names and captions.
    notes
        Paragraphs of plain text for the top of the page.
    views
        Data of the interactive charts from `chart_data`: ``methods`` (see its `method_looks`),
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
    placed = _placed(drawn, metrics.get("training", {}).get("peak"))
    judged = metrics.get("verdicts", {}).get("table", {})
    views = _json_ready(views or {})
    html = rendered(
        "report.html",
        title="CPU-Net validation",
        compared={name: number(v) for name, v in metrics.get("compared", {}).items()},
        first=_gallery(placed["first"]),
        notes=notes,
        verdicts=verdicts_html(metrics.get("verdicts")),
        scores=joined(
            peak_html(name, scores, judged.get(name))
            for name, scores in metrics.get("peaks", {}).items()
        )
        or part("gap", "no peak was scored"),
        shapes=joined(
            [
                _views_html(views, ("distributions",), placed["distributions"]),
                _of_all_peaks("Distributions", placed["distributions"]),
                _views_html(views, ("slices",), placed["slices"]),
                _of_all_peaks("Mean pulses by rise time", placed["slices"]),
            ]
        ),
        pulses=_views_html(views, ("pulses", "scatter")),
        survival=survival_html(metrics.get("ae_survival", {})),
        ae=joined(
            [_gallery(placed["ae"]), _of_all_peaks("A/E and drift time", placed["ae_drift"])]
        ),
        ae_energy=ae_energy,
        noise=_gallery(placed["noise"]),
        details=_details_html(metrics),
        figures=_gallery(placed["others"]) or part("gap", "no figures were drawn"),
        rejections=pairs_table(metrics.get("rejections", {}), ("Reason", "Pulses")),
        training=pairs_table(metrics.get("training", {}), ("Setting", "Value")),
        script=script(views, SCRIPTS) if _drawn(views) else "",
    )
    (folder / "report.html").write_text(html, encoding="utf-8")


def _placed(drawn: Mapping[str, Markup], trained_on: str | None) -> dict[str, list[Markup]]:
    """Figures by their place on the page, see `PLACES`.

    Mean pulses and noise are shown for a few peaks, preferably not those of the training.
    """
    trained = tuple(f"{peak} " for peak in [trained_on, *str(trained_on).split(",")])
    names: dict[str, list[str]] = {place: [] for place in [*PLACES.values(), "others"]}
    for name in drawn:
        told = name.replace("_", " ")
        end = next((end for end in PLACES if told.endswith(end)), None)
        names[PLACES[end] if end else "others"].append(name)
    for place in ("first", "noise"):
        held_out = [name for name in names[place] if not name.startswith(trained)]
        few = (held_out or names[place])[:FIRST]
        names["others"] += [name for name in names[place] if name not in few]
        names[place] = few
    return {place: [drawn[name] for name in chosen] for place, chosen in names.items()}


def _of_all_peaks(title: str, drawn: Sequence[Markup]) -> Markup:
    if not drawn:
        return Markup()
    return part("folded", f"{title} of every peak, as figures", part("grid", "figures", drawn))


def _drawn(views: Mapping[str, Any]) -> bool:
    return any(views.get(name) for name in VIEWS)


def _views_html(
    views: Mapping[str, Any], names: Sequence[str], figures: Sequence[Markup] = ()
) -> Markup:
    """Elements in which the script draws, or the reason why it does not.

    In print the figures replace them, if there are any.
    """
    if not _drawn(views):
        return part("gap", "this report was written without the data of the interactive views")
    return joined(
        part("view", name, *VIEWS[name], bool(views.get(name)), bool(figures)) for name in names
    )


def _details_html(metrics: Mapping[str, Any]) -> Markup:
    """Return those parts of the metrics that are shown as nested tables, if any."""
    return joined(
        part("folded", title, nested_html(metrics[name]), screen=True)
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
