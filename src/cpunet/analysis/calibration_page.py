"""A calibration as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cpunet.analysis.calibration_figures import (
    directions_figure,
    profiles_figure,
    pulls_figure,
)
from cpunet.analysis.html_pages import figure_html, rendered
from cpunet.analysis.nested_tables import with_std
from cpunet.calibration.titles import titled

_PROFILES = (
    "Profile of chi-square for each parameter, with all others refitted; grey: the parabola of "
    "the quoted error; dashed: as simulated."
)
_PULLS = (
    "Deviation of each function of the pulses from the data in standard deviations; grey: ± 2."
)
_DIRECTIONS = "Left: composition of each direction. Right: its error; 1 is that of the prior."


def calibration_page(content: Mapping[str, Any]) -> str:
    """Return the page as HTML.

    Parameters
    ----------
    content
        Content of ``calibration.json``.
    """
    free, directions = content["parameters"], content["directions"]
    shown = ("events", "notes", "parameters", "fixed", "covariance", "directions")
    return rendered(
        "calibration.html",
        title=f"Detector and readout of {content['detector']}, calibrated together",
        with_std=with_std,
        titled=titled,
        chi=content["chi_square"],
        profiles=figure_html(_PROFILES, profiles_figure(content)) if free else "",
        pulls=figure_html(_PULLS, pulls_figure(content)),
        drawn_directions=figure_html(_DIRECTIONS, directions_figure(directions))
        if directions
        else "",
        **{name: content[name] for name in shown},
    )
