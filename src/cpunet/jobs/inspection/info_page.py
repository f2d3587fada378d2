"""Write the description of a file as an HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cpunet.analysis.html_pages import figure_html, rendered
from cpunet.analysis.spectrum_figure import Spectrum, spectrum_figure
from cpunet.files import written_aside
from cpunet.jobs.inspection.info_words import in_words
from cpunet.pulses.spectrum import CAESIUM, LINE_KEV, SOURCES

Spectra = dict[str, Spectrum]  # by channel; "" for a file with one


def write_info_page(out: Path, told: Mapping[str, Any], spectra: Spectra) -> None:
    """Write a page with the description of a file and its spectra.

    Parameters
    ----------
    out
        Page to write.
    told
        Result of `cpunet.jobs.inspection.info.describe`.
    spectra
        Spectrum of each table that was read.
    """
    if told["kind"] == "channels":
        of_each = told["channels"]
    elif told["kind"] == "tables":
        of_each = {
            name: one if isinstance(one, str) else _of_table(one)
            for name, one in told["tables"].items()
        }
    else:
        of_each = {"": told}
    html = rendered(
        "info.html",
        title=f"What is in {Path(told['path']).name}",
        path=told["path"],
        sections=[_section(name, one, spectra.get(name)) for name, one in of_each.items()],
        sources=SOURCES | {CAESIUM: (LINE_KEV,)},
    )
    with written_aside(out) as aside:
        aside.write_text(html, encoding="utf-8")


def _of_table(told: Mapping[str, Any]) -> dict[str, str]:
    size = f"{told['n_pulses']} of {told['length']} samples, every {told['dt_ns']:g} ns"
    return {"traces": size, "energy": str(told["energy"])}


def _section(
    name: str, told: Mapping[str, Any] | str, spectrum: Spectrum | None
) -> dict[str, Any]:
    section: dict[str, Any] = {
        "name": name,
        "problem": told if isinstance(told, str) else "",
        "lines": [],
        "figure": "",
        "found": "",
    }
    if not isinstance(told, str):
        section["lines"] = in_words(told) if "kind" in told else list(told.items())
    if spectrum is not None and np.isfinite(spectrum.values).any():
        caption = "Energies" if spectrum.in_kev else "Amplitudes"
        section["figure"] = figure_html(f"{caption} {name}".strip(), spectrum_figure(spectrum))
        section["found"] = _found(spectrum)
    return section


def _found(spectrum: Spectrum) -> str:
    if spectrum.found is None:
        return "No lines of the sources below stand out."
    source, factor = spectrum.found.source, spectrum.found.kev_per_adc
    lines = ", ".join(f"{line:.0f}" for line in sorted(spectrum.found.lines_kev))
    text = f"Lines of {source} found: {lines} keV."
    if spectrum.in_kev:
        return f"{text} They are at {1 / factor:.4f} of their energies."
    return f"{text} Suggested: --kev-per-adc {factor:.4g}."
