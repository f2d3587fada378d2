"""A/E against energy as a figure and a table: points, and the lines fitted to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from cpunet.html_pages import joined, part
from cpunet.plotting import GROUP, colours, group, label, styled
from cpunet.tables import with_std
from cpunet.validation.ae_energy import REFERENCE_KEV
from cpunet.validation.nested_tables import html_table

FIGURE = "A over E and energy"


@styled
def ae_energy_figure(methods: Mapping[str, Any]) -> Figure:
    """Relative shift and relative width of the single-site peak of A/E against energy.

    Parameters
    ----------
    methods
        ``methods`` of `ae_energy.against_energy`.
    """
    figure = Figure(figsize=(6.4, 5.6))
    above, below = figure.subplots(2, 1, sharex=True)
    palette = colours(methods)
    for method, found in methods.items():
        points, colour = found["points"], palette[method]
        energy, mean, error, sigma, sigma_error = (
            np.array([point[name] for point in points], float)
            for name in ("energy_kev", "mean", "mean_error", "sigma", "sigma_error")
        )
        scale, line, law = found["scale"], found["mean"], found["resolution"]
        look = {"color": colour, "linestyle": "none", "marker": "o", "markersize": 3.5}
        for axes, value, spread in (
            (above, mean / scale - 1, error / scale),
            (below, sigma / mean, sigma_error / mean),
        ):
            group(axes.errorbar(energy, 100 * value, 100 * spread, **look), method)
        along = np.linspace(energy.min(), energy.max(), 100)
        told = f"{label(method)}: {line['per_mev_percent']:+.3f} ± "
        told += f"{line['per_mev_error_percent']:.3f} % per MeV"
        fit = {"color": colour, "gid": GROUP + method}
        above.plot(along, 100 * (line["a"] * along + line["b"] - 1), label=told, **fit)
        width = np.sqrt(law["a"] + (law["b"] / along) ** law["c"])
        below.plot(along, 100 * width, **fit)
    above.set_ylabel(f"A/E over that at {REFERENCE_KEV:g} keV, − 1 [%]")
    below.set(ylabel="Width σ of A/E [%]", xlabel="Energy [keV]")
    above.legend()
    return figure


def ae_energy_html(found: Mapping[str, Any], figure: Markup) -> Markup:
    """Return the section's content: a sentence, a table of the lines, and the figure."""
    if not found:
        return Markup()
    if "missing" in found:
        return part("gap", found["missing"])
    rows = []
    for method, one in found["methods"].items():
        line, law = one["mean"], one["resolution"]
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
    head = [
        "Method",
        "Slope [% per MeV]",
        "χ² / degrees",
        "Width at all energies [%]",
        "Noise [keV]",
        f"Width at {REFERENCE_KEV:g} keV [%]",
    ]
    about = (
        "Position and width of the single-site peak of A/E in ranges of energy: a Gaussian "
        "with a tail below it. “cpunet export legend” writes these lines."
    )
    if found.get("multi_site"):
        about += (
            " Since there are too few events between the lines, SEP and FEP are fitted too, "
            "although most of their events have several sites: slopes can be compared, but "
            "only approximate that of single sites. A range of the recipe's "
            "scores.continuum_kev, as 900 to 2350, is read, if the files have it."
        )
    drawn = part("grid", "figures", [figure] if figure else [])
    return joined([part("p", about), html_table(head, rows, words={0}), drawn])
