"""The page of a validation, and its figures as files.

The page is self-contained: figures and script are embedded, and its content security policy
blocks all requests.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from markupsafe import Markup
from matplotlib.figure import Figure

from cpunet.html_pages import asset, figure_html, joined, rendered
from cpunet.plotting import COLOURS, label
from cpunet.progress import stage
from cpunet.pulses.parameters import PARAMETERS
from cpunet.pulses.shape_parameters import LABELLED
from cpunet.settings import flat
from cpunet.tables import NO_VALUE, number, with_std
from cpunet.validation.metrics import Metrics, called
from cpunet.validation.report import PAGE

FIRST = 3  # figures of overlap and mean pulses at the top of the page, and of noise
# What a figure shows, for readers of its text alone, by the end of its name.
SHOWS = {
    "overlap with data": "overlap with the data by quantity and method; band: data with data",
    "mean pulse": "mean pulse of the data and each method; differences in standard errors",
    "superpulses": "mean pulses in four ranges of rise time; differences in standard errors",
    "noise": "noise power before the pulse by frequency, data and REN; their ratio",
    "single pulse": "one simulated pulse by each method, and the nearest measured one",
    "further parameters": "distributions of further parameters, data and each method",
    "A over E survival": "survival of other peaks against that of the double-escape peak",
    "A over E and energy": "position and width of the single-site peak of A/E against energy",
}
DISTRIBUTION = "distribution in the data and by each method, and differences in standard errors"
# section of a figure by the end of its name; all others are under Details
PLACES = {
    "overlap with data": "first",
    "a over e": "distributions",
    "rise time": "distributions",
    "lq": "distributions",
    "A over E survival": "ae",
    "A over E and energy": "ae_energy",
    "mean pulse": "first",
    "superpulses": "slices",
    "noise": "noise",
    "single pulse": "pulses",
    "further parameters": "further",
    **{parameter.replace("_", " "): "distributions" for parameter in PARAMETERS},
}


def write_page(
    folder: Path,
    metrics: Metrics,
    figures: Mapping[str, Callable[[], Figure]],
    notes: Sequence[str],
) -> None:
    """Write an SVG per figure and ``report.html`` into a folder.

    Parameters
    ----------
    folder
        An existing folder, see `outputs.folder_written_aside`.
    metrics
        Content of ``metrics.json``.
    figures
        Functions that draw a figure, by name; the names become file names and captions.
    notes
        Paragraphs of plain text for the top of the page.
    """
    drawn = {}
    with stage("Drawing", len(figures)) as bar:
        for name, draw in figures.items():
            stem = re.sub(r"[^\w.-]+", "_", name)  # file systems refuse some characters
            shows = next((t for end, t in SHOWS.items() if name.endswith(end)), DISTRIBUTION)
            file = folder / f"{stem}.svg"
            drawn[name] = figure_html(name.replace("_", " "), draw(), file, shows)
            bar.update(1)
    # of each method that is drawn, for the page's legend
    methods = dict.fromkeys(re.findall('data-method="([^"]*)"', joined(drawn.values())))
    good, verdict = metrics.headline() if metrics.scored else (False, "")
    html = rendered(
        "report.html",
        title="CPU-Net validation",
        metrics=metrics,
        placed=_placed(drawn, metrics.training.get("peak")),
        notes=notes,
        good=good,
        headline=verdict,
        methods=[{"name": m, "label": label(m), "colour": COLOURS[m]} for m in methods],
        rejections=[*flat(metrics.rejections, ": ")],
        training=[*flat(metrics.training, ": ")],
        script=Markup(asset("report.js")),
        **{f.__name__: f for f in (called, label, number, percent, thousandths, with_std)},
        unit=lambda name: LABELLED[name].unit,
    )
    (folder / PAGE).write_text(html, encoding="utf-8")


def _placed(drawn: Mapping[str, Markup], trained_on: str | None) -> dict[str, list[Markup]]:
    """Figures by their place on the page, see `PLACES`.

    Mean pulses and noise are shown for a few peaks, preferably not those of the training.
    """
    trained = tuple(f"{peak} " for peak in [trained_on, *str(trained_on).split(",")])
    names: dict[str, list[str]] = {place: [] for place in [*PLACES.values(), "others"]}
    for name in drawn:
        end = next((end for end in PLACES if name.replace("_", " ").endswith(end)), None)
        names[PLACES[end] if end else "others"].append(name)
    for place in ("first", "noise"):
        held_out = [name for name in names[place] if not name.startswith(trained)]
        few = (held_out or names[place])[:FIRST]
        names["others"] += [name for name in names[place] if name not in few]
        names[place] = few
    return {place: [drawn[name] for name in chosen] for place, chosen in names.items()}


def thousandths(value: float | None) -> str:
    """Three digits of a thousand times a value."""
    return NO_VALUE if value is None else f"{1e3 * value:#.3g}".rstrip(".")


def percent(value: float | None, error: float | None) -> str:
    """A value and its error, if any, to a tenth."""
    if value is None:
        return NO_VALUE
    value = round(value, 1) + 0.0  # no negative zero
    return f"{value:.1f}" if error is None else f"{value:.1f} ± {error:.1f}"
