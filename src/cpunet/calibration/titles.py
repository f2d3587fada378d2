"""Titles of the parameters of the physics on pages, in figures and on the terminal."""

from __future__ import annotations

import re

# By name in files: the title, and the unit or the kind of a number without one.
TITLES = {
    "temperature_K": ("temperature", "[K]"),
    "impurity_factor": ("impurity", "(factor)"),
    "self_repulsion": ("self-repulsion", "(factor)"),
    "diffusion_constant": ("diffusion constant", "[V mm/cm]"),
    "cloud_fwhm_mm": ("cloud FWHM", "[mm]"),
    "impurity_tilt_1e10_per_cm4": ("impurity tilt", "[10¹⁰/cm⁴]"),
    "hole_velocity_low_factor": ("hole velocity at low field", "(factor)"),
    "hole_velocity_high_factor": ("hole velocity at high field", "(factor)"),
    "electron_velocity_low_factor": ("electron velocity at low field", "(factor)"),
    "electron_velocity_high_factor": ("electron velocity at high field", "(factor)"),
    "hole_trapping_per_us": ("hole trapping", "[1/µs]"),
    "electron_trapping_per_us": ("electron trapping", "[1/µs]"),
    "bias_V": ("bias", "[V]"),
    "li_thickness_mm": ("lithium layer", "[mm]"),
}
_NAMES = re.compile(rf"\b({'|'.join(TITLES)})\b")


def titled(text: str, *, units: bool = True) -> str:
    """Put titles in place of the names of parameters in a text.

    Examples
    --------
    >>> titled("temperature_K"), titled("0.94 temperature_K", units=False)
    ('temperature [K]', '0.94 temperature')
    """

    def title(found: re.Match[str]) -> str:
        words, unit = TITLES[found[1]]
        return f"{words} {unit}" if units else words

    return _NAMES.sub(title, text)
