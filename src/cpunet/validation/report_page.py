"""The page of a validation, and its figures as files.

The page is self-contained: figures and script are embedded, and its content security policy
blocks all requests.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from cpunet.html_pages import (
    asset,
    figure_html,
    figure_png,
    joined,
    part,
    rendered,
)
from cpunet.plotting import colours, label
from cpunet.pulses.parameters import PARAMETERS
from cpunet.tables import number
from cpunet.validation.ae_energy_figure import FIGURE as AE_ENERGY
from cpunet.validation.ae_energy_figure import ae_energy_html
from cpunet.validation.nested_tables import nested_html
from cpunet.validation.report import PAGE
from cpunet.validation.report_tables import (
    pairs_table,
    peak_html,
    survival_html,
    verdicts_html,
)

FIRST = 2  # figures of mean pulses at the top of the page, and of noise
# section of a figure by the end of its name; all others are under Details
PLACES = {
    "A over E survival": "ae",
    "A over E": "ae_drift",
    "mean pulse": "first",
    "superpulses": "slices",
    "noise": "noise",
    "single pulse": "pulses",
    "further parameters": "further",
    **{parameter.replace("_", " "): "distributions" for parameter in PARAMETERS},
}
MANY = 4  # a larger number of figures is collapsed

# parts of the metrics that are shown as nested tables
DETAILS = {
    "ae_details": "A/E in detail",
    "drift_slices": "Slices of rise time, 1 to 90 %",
    "noise": "Noise",
}


def write_page(
    folder: Path,
    metrics: Mapping[str, Any],
    figures: Mapping[str, Figure],
    notes: Sequence[str],
) -> None:
    """Write a PNG per figure and ``report.html`` into a folder.

    Parameters
    ----------
    folder
        An existing folder, see `outputs.folder_written_aside`.
    metrics
        ``peaks``: by peak, ``n_sim``, ``n_data``, ``not_prepared`` (counts by method),
        ``parameters`` (result of `comparisons.compare`), ``two_sample`` (classifier test by
        method) and, if the truth is known, ``paired`` (result of `paired.scores_of_squares` by
        method); or ``missing`` with the reason why the peak is not scored.
        ``verdicts``: ``summary``, a list of sentences, and ``table``, see
        `verdicts.verdict_table`.  ``ae_survival``, ``ae_details``,
        ``drift_slices``, ``noise``: nested values, shown as tables.
        ``compared``: names and values of the compared inputs.  ``training``: how the network
        was trained.  ``rejections``: counts by reason, possibly nested.  ``ae_energy``: result
        of `ae_energy.against_energy`.
    figures
        Figures by name; the names become file names and captions.
    notes
        Paragraphs of plain text for the top of the page.
    """
    drawn = {}
    for name, figure in figures.items():
        (folder / f"{_file_stem(name)}.png").write_bytes(figure_png(figure))
        drawn[name] = figure_html(name.replace("_", " "), figure)
    ae_energy = ae_energy_html(metrics.get("ae_energy", {}), drawn.pop(AE_ENERGY, Markup()))
    placed = _placed(drawn, metrics.get("training", {}).get("peak"))
    judged = metrics.get("verdicts", {}).get("table", {})
    scores = joined(
        peak_html(name, scores, judged.get(name))
        for name, scores in metrics.get("peaks", {}).items()
    )
    html = rendered(
        "report.html",
        title="CPU-Net validation",
        compared={name: number(v) for name, v in metrics.get("compared", {}).items()},
        first=_gallery(placed["first"]),
        notes=notes,
        verdicts=verdicts_html(metrics.get("verdicts")),
        methods=_methods([*drawn.values(), scores]),
        scores=scores or part("gap", "no peak was scored"),
        distributions=part("grid", "figures", placed["distributions"]),
        further=_folded("Further parameters of every peak", placed["further"], screen=True),
        slices=part("grid", "figures", placed["slices"]),
        pulses=part("grid", "single", placed["pulses"]),
        survival=survival_html(metrics.get("ae_survival", {})),
        ae=joined(
            [
                _gallery(placed["ae"]),
                _folded("A/E against drift time of every peak, as figures", placed["ae_drift"]),
            ]
        ),
        ae_energy=ae_energy,
        noise=_gallery(placed["noise"]),
        details=_details_html(metrics),
        figures=_gallery(placed["others"]) or part("gap", "no figures were drawn"),
        rejections=pairs_table(metrics.get("rejections", {}), ("Reason", "Pulses")),
        training=pairs_table(metrics.get("training", {}), ("Setting", "Value")),
        script=Markup(asset("report.js")),
    )
    (folder / PAGE).write_text(html, encoding="utf-8")


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


def _methods(drawn: Iterable[str]) -> list[dict[str, str]]:
    """Name, label and colour of each method that is drawn, for the page's legend."""
    names = dict.fromkeys(re.findall('data-method="([^"]*)"', joined(drawn)))
    return [{"name": m, "label": label(m), "colour": c} for m, c in colours(names).items()]


def _folded(title: str, drawn: Sequence[Markup], *, screen: bool = False) -> Markup:
    figures = part("grid", "figures", drawn)
    return part("folded", title, figures, screen=screen) if drawn else Markup()


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
