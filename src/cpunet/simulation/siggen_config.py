"""Configuration files of siggen and fieldgen: lines with a key and a number."""

from __future__ import annotations

import math
from typing import Any

from cpunet.errors import CpunetError

_FIELDS = {
    "xtal_length": "crystal_length",
    "xtal_radius": "crystal_radius",
    "top_bullet_radius": "top_bullet_radius",
    "bottom_bullet_radius": "bottom_bullet_radius",
    "pc_length": "point_contact_length",
    "pc_radius": "point_contact_radius",
    "taper_length": "bottom_taper_length",
    "bottom_taper_length": "bottom_taper_length",
    "wrap_around_radius": "wrap_around_radius",
    "ditch_depth": "ditch_depth",
    "ditch_thickness": "ditch_thickness",
    "hole_length": "bore_length",
    "hole_radius": "bore_radius",
    "hole_bullet_radius": "bore_bullet_radius",
    "outer_taper_length": "outer_taper_length",
    "inner_taper_length": "inner_taper_length",
    "taper_angle": "taper_angle_deg",
    "Li_thickness": "li_thickness",
    "vacuum_gap": "vacuum_gap",
    "impurity_z0": "impurity_z0_1e10_per_cm3",
    "impurity_gradient": "impurity_gradient_1e10_per_cm4",
    "impurity_quadratic": "impurity_quadratic_1e10_per_cm3",
    "impurity_surface": "surface_charge_1e10_per_cm2",
    "impurity_radial_add": "impurity_radial_add_1e10_per_cm3",
    "impurity_radial_mult": "impurity_radial_mult",
    "impurity_rpower": "impurity_radial_power",
    "xtal_HV": "bias_V",
    "xtal_temp": "temperature_K",
    "xtal_grid": "grid_mm",
}
# alternative or neutral values, evaluated below
_DERIVED = ("hole_length_gap", "outer_taper_width", "inner_taper_width", "bulletize_PC")
# settings of the drift, and names of the program's files
_NOT_OF_THE_DETECTOR = (
    "drift_name",
    "field_name",
    "wp_name",
    "preamp_tau",
    "time_steps_calc",
    "step_time_calc",
    "step_time_out",
    "charge_cloud_size",
    "use_diffusion",
    "energy",
    "verbosity",
    "verbosity_level",
    "max_iterations",
    "write_field",
    "write_WP",
    "surface_drift_vel_factor",
)


def detector_values(text: str, name: str) -> dict[str, Any]:
    r"""Fields of `Detector` from the content `text` of the configuration file `name`.

    Raises
    ------
    CpunetError
        If a key is unknown or has no number.

    Examples
    --------
    >>> detector_values("xtal_length 96.0  # mm\nxtal_HV 4000\n", "V.config")
    {'crystal_length': 96.0, 'bias_V': 4000.0}
    """
    values: dict[str, float] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words or words[0] in _NOT_OF_THE_DETECTOR:
            continue
        if words[0] not in _FIELDS and words[0] not in _DERIVED:
            raise CpunetError(
                f"detector {name}: line {number}: unknown key {words[0]}; "
                "neither siggen nor fieldgen has it"
            )
        try:
            values[words[0]] = float(words[1])
        except (IndexError, ValueError) as error:
            raise CpunetError(
                f"detector {name}: line {number}: {words[0]} has no number; give one"
            ) from error
    fields = {_FIELDS[key]: value for key, value in values.items() if key in _FIELDS}
    if values.get("bulletize_PC"):
        raise CpunetError(
            f"detector {name}: rounded point contacts are not simulated; set bulletize_PC to 0"
        )
    if "hole_length_gap" in values and "hole_length" not in values:
        length = values.get("xtal_length", math.nan)
        fields["bore_length"] = length - values["hole_length_gap"]
    for side, angle in (("outer", "taper_angle_deg"), ("inner", "inner_taper_angle_deg")):
        width, length = (values.get(f"{side}_taper_{x}", 0.0) for x in ("width", "length"))
        if width and length and "taper_angle" not in values:
            fields[angle] = math.degrees(math.atan(width / length))
    # siggen keeps the radius and the rounding of a hole that does not exist
    if not fields.get("bore_length"):
        fields = {k: v for k, v in fields.items() if not k.startswith("bore_")}
    return fields
