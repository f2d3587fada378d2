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

from cpunet.html_pages import asset, figure_html, rendered
from cpunet.plotting import COLOURS, label
from cpunet.progress import stage
from cpunet.pulses.shape_parameters import LABELLED
from cpunet.settings import flat
from cpunet.tables import number, with_std
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
    "losses": "losses of the training by iteration",
    "cycle of simulation": "simulated pulses, their translations, and those back",
    "cycle of data": "measured pulses, their translations, and those back",
    "": "distribution in the data and by each method, and differences in standard errors",
}
SECTIONS = {  # of figures, by the ends of their names
    "first": ("overlap with data", "mean pulse"),
    "slices": ("superpulses",),
    "noise": ("noise",),
    "pulses": ("single pulse",),
    "further": ("further parameters",),
    "ae": ("A over E survival",),
    "ae_energy": ("A over E and energy",),
    "others": ("losses", "cycle of simulation", "cycle of data"),
    "distributions": ("",),
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
    placed: dict[str, dict[str, Markup]] = {place: {} for place in SECTIONS}
    with stage("Drawing", len(figures)) as bar:
        for name, draw in figures.items():
            stem = re.sub(r"[^\w.-]+", "_", name)  # file systems refuse some characters
            caption = name.replace("_", " ")
            place = next(p for p, ends in SECTIONS.items() if caption.endswith(ends))
            shows = next(text for end, text in SHOWS.items() if caption.endswith(end))
            placed[place][name] = figure_html(caption, draw(), folder / f"{stem}.svg", shows)
            bar.update(1)
    # of each method that is drawn, for the page's legend
    drawn = "".join(html for of_place in placed.values() for html in of_place.values())
    methods = dict.fromkeys(re.findall('data-method="([^"]*)"', drawn))
    # of mean pulses and noise a few, preferably of peaks that took no part in the training
    peak = str(metrics.training.get("peak"))
    trained = tuple(f"{name} " for name in (peak, *peak.split(",")))
    for place in ("first", "noise"):
        shown = placed[place]
        few = [n for n in shown if not n.startswith(trained)][:FIRST] or [*shown][:FIRST]
        placed["others"] |= {name: html for name, html in shown.items() if name not in few}
        placed[place] = {name: shown[name] for name in few}
    good, verdict = metrics.headline() if metrics.scored else (False, "")
    html = rendered(
        "report.html",
        title="CPU-Net validation",
        metrics=metrics,
        placed={place: [*of_place.values()] for place, of_place in placed.items()},
        notes=notes,
        good=good,
        headline=verdict,
        methods=[{"name": m, "label": label(m), "colour": COLOURS[m]} for m in methods],
        rejections=[*flat(metrics.rejections, ": ")],
        training=[*flat(metrics.training, ": ")],
        script=Markup(asset("report.js")),
        **{f.__name__: f for f in (called, label, number, with_std)},
        unit=lambda name: LABELLED[name].unit,
    )
    (folder / PAGE).write_text(html, encoding="utf-8")
