"""The page of a validation, and its figures as files.

The page is self-contained: figures and script are embedded, and its content security policy
blocks all requests.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from cpunet.html_pages import asset, figure_html, joined, part, rendered
from cpunet.plotting import COLOURS, label
from cpunet.progress import stage
from cpunet.pulses.parameters import PARAMETERS
from cpunet.pulses.shape_parameters import LABELLED
from cpunet.settings import flat
from cpunet.tables import NO_VALUE, number, with_std
from cpunet.validation.a_over_e import RangeSurvival
from cpunet.validation.ae_energy import REFERENCE_KEV, AgainstEnergy
from cpunet.validation.comparisons import Compared, Missing
from cpunet.validation.metrics import Metrics, PeakScores, called
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
    placed = _placed(drawn, metrics.training.get("peak"))
    good, verdict = metrics.headline() if (peaks := metrics.held_out) else (False, "")
    # of each method that is drawn, for the page's legend
    methods = dict.fromkeys(re.findall('data-method="([^"]*)"', joined(drawn.values())))
    html = rendered(
        "report.html",
        title="CPU-Net validation",
        compared=metrics.compared,
        placed=placed,
        notes=notes,
        good=good,
        headline=verdict,
        table=part("main_table", *metrics.main_table(peaks)) if peaks else "",
        verdicts=verdicts_html(metrics),
        methods=[{"name": m, "label": label(m), "colour": COLOURS[m]} for m in methods],
        scores=joined(peak_html(name, scores) for name, scores in metrics.peaks.items()),
        survival=survival_html(metrics),
        ranges=ranges_table(metrics.ae_details.get("survival by energy range", {})),
        ae_energy=ae_energy_html(metrics.ae_energy),
        multi_site=metrics.ae_energy.multi_site,
        noise=noise_table(metrics.peaks),
        rejections=pairs_table(metrics.rejections, ("Reason", "Pulses")),
        training=pairs_table(metrics.training, ("Setting", "Value")),
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
        end = next((end for end in PLACES if name.replace("_", " ").endswith(end)), None)
        names[PLACES[end] if end else "others"].append(name)
    for place in ("first", "noise"):
        held_out = [name for name in names[place] if not name.startswith(trained)]
        few = (held_out or names[place])[:FIRST]
        names["others"] += [name for name in names[place] if name not in few]
        names[place] = few
    return {place: [drawn[name] for name in chosen] for place, chosen in names.items()}


def verdicts_html(metrics: Metrics) -> Markup:
    """Return the verdicts in plain words; nothing without any."""
    rows = [
        [
            *(peak, label(method), called(quantity), verdict.numbers),
            *(number(verdict.p), verdict.words),
        ]
        for peak, scores in metrics.peaks.items()
        for method in scores.methods
        for quantity, verdict in metrics.judge(peak, method).items()
    ]
    if not rows:
        return Markup()
    head = ["Peak", "Method", "Quantity", "Difference", "p", "Verdict"]
    words = part("points", [metrics.summary(peak) for peak in metrics.scored])
    table = part("table", head, rows, {0, 1, 2, 5})
    return joined([
        part("folded", "All quantities in words", words),
        part("folded", "Each verdict", table, screen=True),
    ])  # fmt: skip


def peak_html(peak: str, scores: PeakScores) -> Markup:
    """Return the section of one peak: numbers of events and tables."""
    n_sim, n_data = number(scores.n_sim), number(scores.n_data)
    parts = [part("heading", 3, f"{peak}: {n_sim} simulated, {n_data} measured pulses")]
    if scores.missing:
        parts.append(part("p", f"Not scored: {scores.missing}."))
    if scores.parameters:
        parts.append(_parameter_table(scores.parameters))
    if scores.further:
        title = f"Further parameters: {len(scores.further)}"
        parts.append(part("folded", title, _parameter_table(scores.further), screen=True))
    if scores.not_prepared:
        counts = (f"{label(m)}: {n}" for m, n in scores.not_prepared.items())
        text = "Simulated pulses left out because, once translated, they cannot be prepared "
        parts.append(part("p", f"{text}like data: {'; '.join(counts)}."))
    tables = []
    if scores.two_sample:
        head = ["Distinguished from data by a classifier", "AUC", "Null AUC"]
        rows = [
            [label(method), NO_VALUE, tested.missing]
            if isinstance(tested, Missing)
            else [
                label(method),
                with_std(tested.auc, tested.auc_std),
                with_std(tested.null_mean, tested.null_std),
            ]
            for method, tested in scores.two_sample.items()
        ]
        tables.append(part("table", head, rows))
    if scores.paired:
        head = ["Against the true shapes [10⁻³ of the height]", "RMSE", "RMSE of the edge"]
        rows = [
            [label(method)]
            + [
                NO_VALUE if rms is None else f"{1e3 * rms:#.3g}".rstrip(".")
                for rms in (paired.rmse, paired.edge_rmse)
            ]
            for method, paired in scores.paired.items()
        ]
        tables.append(part("table", head, rows))
    return joined([*parts, part("grid", "beside", tables)])


def survival_html(metrics: Metrics) -> Markup:
    """Return the survival of A/E cuts by peak and method."""
    if isinstance(metrics.ae_survival, Missing):
        return part("p", f"Not scored: {metrics.ae_survival.missing}.")
    if not metrics.ae_survival:
        return part("p", "None recorded.")
    rows = []
    for peak, row in metrics.ae_survival.items():
        title = peak
        for method, share in row.survival.items():
            sigma = row.sigma.get(method)
            rows.append([
                *(title, label(method), _percent(share, row.survival_std.get(method))),
                _percent(row.difference.get(method), row.difference_std.get(method)),
                NO_VALUE if sigma is None else f"{round(sigma, 1) + 0.0:+.1f}",
            ])  # fmt: skip
            title = ""
    head = ["Peak", "Method", "Survival [%]", "Minus data [points]", "In σ"]
    return part("table", head, rows, {0, 1})


def ranges_table(ranges: Mapping[str, Mapping[str, RangeSurvival]] | Missing) -> Markup:
    """Return the survival of A/E cuts by ranges of energy and method."""
    if not ranges or isinstance(ranges, Missing):
        return Markup()
    rows = [
        [
            *(name, label(method), str(result.peak)),
            _percent(result.survival, result.survival_std),
            result.missing or "",
        ]
        for name, methods in ranges.items()
        for method, result in methods.items()
    ]
    return part("table", ["Range", "Method", "Pulses", "Survival [%]", ""], rows, {0, 1, 4})


def noise_table(peaks: Mapping[str, PeakScores]) -> Markup:
    """Return the RMS of the noise before the pulse by peak and method."""
    rows = [
        [peak, label(method), number(noise.n), number(noise.samples),
         with_std(noise.rms, noise.rms_std),
         *map(number, (noise.rms_ratio, noise.sigma, noise.spectrum_sigma))]
        for peak, scores in peaks.items()
        for method, noise in scores.noise.items()
    ]  # fmt: skip
    head = ["Peak", "Method", "Pulses", "Samples", "RMS [height]", "Over the data's", "In σ"]
    return part("table", [*head, "Spectrum in σ"], rows, {0, 1}) if rows else Markup()


def ae_energy_html(result: AgainstEnergy) -> Markup:
    """Return a table of the lines."""
    if not result.methods:
        return part("gap", result.missing) if result.missing else Markup()
    rows = []
    for method, course in result.methods.items():
        line, law = course.mean, course.resolution
        rows.append([
            label(method),
            with_std(line.per_mev_percent, line.per_mev_error_percent),
            f"{line.chi_square:.1f} / {line.degrees}",
            f"{100 * np.sqrt(law.a):.2f}",
            f"{law.b:.2f}",
            f"{law.at_reference_percent:.2f}",
        ])  # fmt: skip
    head = ["Method", "Slope [% per MeV]", "χ² / degrees", "Width at all energies [%]"]
    head += ["Noise [keV]", f"Width at {REFERENCE_KEV:g} keV [%]"]
    return part("table", head, rows, {0})


def pairs_table(values: Mapping[str, Any], head: tuple[str, str]) -> Markup:
    """Return a table of names and values; nested names are joined: ``data: saturated``."""
    rows = [[name, number(value)] for name, value in flat(values, ": ")]
    return part("table", head, rows) if rows else part("p", "None recorded.")


def _parameter_table(parameters: Mapping[str, Compared]) -> Markup:
    """One row per parameter and method, and one of data with data."""
    rows = []
    for name, compared in parameters.items():
        unit, iou, error = LABELLED[name].unit, compared.iou, compared.iou_std
        title = name.replace("_", " ").capitalize() + (f" [{unit}]" if unit else "")
        for method, distance in compared.wasserstein.items():
            moved = with_std(distance, compared.wasserstein_std.get(method))
            rows.append([title, label(method), _percent(iou[method], error[method]), moved])
            title = ""
        ceiling = _percent(iou.get("ceiling"), error.get("ceiling"))
        null = with_std(compared.wasserstein_null, compared.wasserstein_null_std)
        rows.append([title, label("ceiling"), ceiling, null])
    head = ["Parameter", "Method", "IoU [%]", "W₁ [unit of the parameter]"]
    return part("table", head, rows, {0, 1})


def _percent(value: float | None, error: float | None) -> str:
    if value is None:
        return NO_VALUE
    value = round(value, 1) + 0.0  # no negative zero
    return f"{value:.1f}" if error is None else f"{value:.1f} ± {error:.1f}"
