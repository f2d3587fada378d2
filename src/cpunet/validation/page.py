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
from cpunet.validation.ae_energy import REFERENCE_KEV
from cpunet.validation.report import PAGE
from cpunet.validation.verdicts import Metrics, called, headline, held_out, main_table

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
    ranges = metrics.get("ae_details", {}).get("survival by energy range", {})
    placed = _placed(drawn, metrics.get("training", {}).get("peak"))
    peaks = held_out(metrics)
    good, verdict = headline(metrics) if peaks else (False, "")
    scores = [peak_html(name, scores) for name, scores in metrics.get("peaks", {}).items()]
    # of each method that is drawn, for the page's legend
    methods = dict.fromkeys(re.findall('data-method="([^"]*)"', joined(drawn.values())))
    html = rendered(
        "report.html",
        title="CPU-Net validation",
        compared={name: number(v) for name, v in metrics.get("compared", {}).items()},
        placed=placed,
        notes=notes,
        good=good,
        headline=verdict,
        table=part("main_table", *main_table(metrics, peaks)) if peaks else "",
        verdicts=verdicts_html(metrics.get("verdicts", {})),
        methods=[{"name": m, "label": label(m), "colour": COLOURS[m]} for m in methods],
        scores=joined(scores),
        survival=survival_html(metrics.get("ae_survival", {})),
        ranges=ranges_table(ranges),
        ae_energy=ae_energy_html(metrics.get("ae_energy", {})),
        multi_site=metrics.get("ae_energy", {}).get("multi_site"),
        noise=noise_table(metrics.get("peaks", {})),
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
        end = next((end for end in PLACES if name.replace("_", " ").endswith(end)), None)
        names[PLACES[end] if end else "others"].append(name)
    for place in ("first", "noise"):
        held_out = [name for name in names[place] if not name.startswith(trained)]
        few = (held_out or names[place])[:FIRST]
        names["others"] += [name for name in names[place] if name not in few]
        names[place] = few
    return {place: [drawn[name] for name in chosen] for place, chosen in names.items()}


def verdicts_html(verdicts: Mapping[str, Any]) -> Markup:
    """Return the verdicts in plain words; nothing without verdicts."""
    if not verdicts:
        return Markup()
    rows = [
        [
            *(peak, label(method), called(quantity), result["numbers"]),
            *(number(result["p"]), result["words"]),
        ]
        for peak, methods in verdicts.get("table", {}).items()
        for method, quantities in methods.items()
        for quantity, result in quantities.items()
    ]
    head = ["Peak", "Method", "Quantity", "Difference", "p", "Verdict"]
    table = part("table", head, rows, {0, 1, 2, 5})
    words = part("folded", "All quantities in words", part("points", verdicts["summary"]))
    return joined([words, part("folded", "Each verdict", table, screen=True) if rows else ""])


def peak_html(peak: str, scores: Mapping[str, Any]) -> Markup:
    """Return the section of one peak: numbers of events and tables."""
    chief, others = scores.get("parameters", {}), scores.get("further", {})
    n_sim, n_data = (number(scores.get(name)) for name in ("n_sim", "n_data"))
    parts = [part("heading", 3, f"{peak}: {n_sim} simulated, {n_data} measured pulses")]
    if "missing" in scores:
        parts.append(part("p", f"Not scored: {scores['missing']}."))
    if chief:
        parts.append(_parameter_table(chief))
    if others:
        title = f"Further parameters: {len(others)}"
        parts.append(part("folded", title, _parameter_table(others), screen=True))
    if scores.get("not_prepared"):
        counts = (f"{label(m)}: {n}" for m, n in scores["not_prepared"].items())
        text = "Simulated pulses left out because, once translated, they cannot be prepared "
        parts.append(part("p", f"{text}like data: {'; '.join(counts)}."))
    tables = []
    if tested := scores.get("two_sample", {}):
        head = ["Distinguished from data by a classifier", "AUC", "Null AUC"]
        pairs = (("auc", "auc_std"), ("null_mean", "null_std"))
        rows = [
            [label(method), NO_VALUE, result["missing"]]
            if "missing" in result
            else [
                label(method),
                *(with_std(result[value], result[std]) for value, std in pairs),
            ]
            for method, result in tested.items()
        ]
        tables.append(part("table", head, rows))
    if paired := scores.get("paired", {}):
        head = ["Against the true shapes [10⁻³ of the height]", "RMSE", "RMSE of the edge"]
        rows = [
            [label(method), _thousandths(result["rmse"]), _thousandths(result["edge_rmse"])]
            for method, result in paired.items()
        ]
        tables.append(part("table", head, rows))
    return joined([*parts, part("grid", "beside", tables)])


def survival_html(survival: Mapping[str, Any]) -> Markup:
    """Return the survival of A/E cuts by peak and method."""
    if not survival:
        return part("p", "None recorded.")
    if "missing" in survival:
        return part("p", f"Not scored: {survival['missing']}.")
    rows = []
    for peak, result in survival.items():
        title = peak
        for method in result.get("survival", {}):
            share, off = (
                _percent(result[key].get(method), result[f"{key}_std"].get(method))
                for key in ("survival", "difference")
            )
            sigma = result["sigma"].get(method)
            in_sigma = NO_VALUE if sigma is None else f"{round(sigma, 1) + 0.0:+.1f}"
            rows.append([title, label(method), share, off, in_sigma])
            title = ""
    head = ["Peak", "Method", "Survival [%]", "Minus data [points]", "In σ"]
    return part("table", head, rows, {0, 1})


def ranges_table(ranges: Mapping[str, Any]) -> Markup:
    """Return the survival of A/E cuts by ranges of energy and method."""
    rows = [
        [
            *(name, label(method), str(result.get("peak", NO_VALUE))),
            _percent(result.get("survival"), result.get("survival_std")),
            result.get("missing", ""),
        ]
        for name, methods in ranges.items()
        if name != "missing"
        for method, result in methods.items()
    ]
    head = ["Range", "Method", "Pulses", "Survival [%]", ""]
    return part("table", head, rows, {0, 1, 4}) if rows else Markup()


def noise_table(peaks: Mapping[str, Any]) -> Markup:
    """Return the RMS of the noise before the pulse by peak and method."""
    rows = [
        [peak, label(method), *(number(result.get(key)) for key in ("n", "samples")),
         with_std(result.get("rms"), result.get("rms_std")),
         *(number(result.get(key)) for key in ("rms_ratio", "sigma", "spectrum_sigma"))]
        for peak, scores in peaks.items()
        for method, result in scores.get("noise", {}).items()
        if method != "frequency_mhz"
    ]  # fmt: skip
    head = ["Peak", "Method", "Pulses", "Samples", "RMS [height]", "Over the data's", "In σ"]
    return part("table", [*head, "Spectrum in σ"], rows, {0, 1}) if rows else Markup()


def ae_energy_html(result: Mapping[str, Any]) -> Markup:
    """Return a table of the lines."""
    if "methods" not in result:
        return part("gap", result["missing"]) if result else Markup()
    rows = []
    for method, fit in result["methods"].items():
        line, law = fit["mean"], fit["resolution"]
        rows.append(
            [
                label(method),
                with_std(line["per_mev_percent"], line["per_mev_error_percent"]),
                f"{line['chi_square']:.1f} / {line['degrees']}",
                f"{100 * np.sqrt(law['a']):.2f}",
                f"{law['b']:.2f}",
                f"{law['at_reference_percent']:.2f}",
            ]
        )
    head = ["Method", "Slope [% per MeV]", "χ² / degrees", "Width at all energies [%]"]
    head += ["Noise [keV]", f"Width at {REFERENCE_KEV:g} keV [%]"]
    return part("table", head, rows, {0})


def pairs_table(values: Mapping[str, Any], head: tuple[str, str]) -> Markup:
    """Return a table of names and values; nested names are joined: ``data: saturated``."""
    rows = [[name, number(value)] for name, value in flat(values, ": ")]
    return part("table", head, rows) if rows else part("p", "None recorded.")


def _parameter_table(parameters: Mapping[str, Any]) -> Markup:
    """One row per parameter and method, and one of data with data."""
    rows = []
    for name, values in parameters.items():
        unit, iou, error = LABELLED[name].unit, values["iou"], values["iou_std"]
        title = name.replace("_", " ").capitalize() + (f" [{unit}]" if unit else "")
        for method, distance in values["wasserstein"].items():
            moved = with_std(distance, values["wasserstein_std"][method])
            off = with_std(values["ks"][method], values["ks_std"][method])
            score = _percent(iou[method], error[method])
            rows.append([title, label(method), score, moved, off])
            title = ""
        ceiling = _percent(iou["ceiling"], error["ceiling"])
        moved, off = (
            with_std(values[f"{kind}_null"], values[f"{kind}_null_std"])
            for kind in ("wasserstein", "ks")
        )
        rows.append([title, "Data vs data", ceiling, moved, off])
    head = ["Parameter", "Method", "IoU [%]", "W₁ [unit of the parameter]", "KS"]
    return part("table", head, rows, {0, 1})


def _thousandths(value: float | None) -> str:
    return NO_VALUE if value is None else f"{1e3 * value:#.3g}".rstrip(".")


def _percent(value: float | None, error: float | None) -> str:
    if value is None:
        return NO_VALUE
    value = round(value, 1) + 0.0  # no negative zero
    return f"{value:.1f}" if error is None else f"{value:.1f} ± {error:.1f}"
