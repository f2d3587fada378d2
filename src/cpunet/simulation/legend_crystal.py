r"""LEGEND metadata of crystals (``hardware/detectors/germanium/crystals``).

The ``impurity_curve`` of a crystal describes the boule from which detectors were cut. As
LegendDataManagement.jl reads it for SolidStateDetectors.jl (its boule impurity densities), it
gives the net acceptors in 1e9/cm3 as a function of the distance :math:`z` from the seed end of
the boule in mm,

.. math:: N(z) = a + b z + c z^2 + n\, e^{(z - l)/m}.

With ``corrections`` this becomes ``scale`` times the curve plus ``offset`` (1e9/cm3). The
``detector_offset_in_mm`` of a slice is the position of its point contact. From there the axis
of the detector runs back to the seed end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from cpunet.errors import CpunetError

# parameters of each model in the curve above
MODELS = {
    "constant_boule": ("value",),
    "linear_boule": ("a", "b"),
    "parabolic_boule": ("a", "b", "c"),
    "linear_exponential_boule": ("a", "b", "n", "l", "m"),
    "parabolic_exponential_boule": ("a", "b", "c", "n", "l", "m"),
}
_ANOTHER = "correct it, or take another file of the crystal"
_LARGEST_EXPONENT = 300
LONGEST_MM = 1e6  # of any boule; squares of larger numbers may overflow


def impurity_values(
    crystal: Mapping[str, Any], source: str, slice_name: str, length_mm: float
) -> dict[str, float]:
    """Impurity fields of `Detector` for one slice of a crystal.

    Parameters
    ----------
    crystal
        Content of the file of the crystal.
    source
        Name of the file for error messages.
    slice_name
        Slice from which the detector was cut, one of ``slices``, such as ``"A"``.
    length_mm
        Length of the detector along the axis in mm.

    Raises
    ------
    CpunetError
        If the curve, a parameter or the slice is missing or unknown.

    Examples
    --------
    A constant 10 x 1e9/cm3 net acceptors are -1e10/cm3.

    >>> crystal = {
    ...     "impurity_curve": {"model": "constant_boule", "parameters": {"value": 10.0}},
    ...     "slices": {"A": {"detector_offset_in_mm": 5.0}},
    ... }
    >>> impurity_values(crystal, "V99000.yaml", "A", 90.0)["impurity_z0_1e10_per_cm3"]
    -1.0
    """
    curve = crystal.get("impurity_curve")
    if not isinstance(curve, Mapping):
        raise CpunetError(f"{source}: no impurity_curve; {_ANOTHER}")
    model = curve.get("model")
    if not isinstance(model, str) or model not in MODELS:
        raise CpunetError(
            f"{source}: impurity_curve.model {model!r} is not known; there are "
            f"{', '.join(MODELS)}; {_ANOTHER}"
        )
    numbers = {
        key: _number(crystal, f"impurity_curve.parameters.{key}", source)
        for key in MODELS[model]
    }
    a = numbers.get("value", numbers.get("a", 0.0))
    b, c, n = (numbers.get(key, 0.0) for key in "bcn")
    place = f"slices.{slice_name}.detector_offset_in_mm"
    contact = _number(crystal, place, source)
    if abs(contact) > LONGEST_MM:
        raise CpunetError(f"{source}: {place} = {contact:g} is too large; {_ANOTHER}")
    scale = _number(crystal, "impurity_curve.corrections.scale", source, 1.0)
    offset = _number(crystal, "impurity_curve.corrections.offset", source, 0.0)
    # z of the boule is that of the contact minus the detector's z; 1e9 acceptors are -0.1 of
    # our unit, and the scale does not apply to the offset
    unit = -0.1 * scale
    values = {
        "impurity_z0_1e10_per_cm3": unit * (a + b * contact + c * contact**2) - 0.1 * offset,
        # z^2 = L z - (L / 2)^2 (1 - (2 z / L - 1)^2), z in mm here and in cm there
        "impurity_gradient_1e10_per_cm4": 10 * unit * (c * length_mm - b - 2 * c * contact),
        "impurity_quadratic_1e10_per_cm3": -unit * c * length_mm**2 / 4,
    }
    if n:
        begin, decay = numbers["l"], numbers["m"]
        exponents = [(z - begin) / decay for z in (contact, contact - length_mm) if decay]
        if not exponents or max(exponents) > _LARGEST_EXPONENT:
            raise CpunetError(
                f"{source}: impurity_curve.parameters.m = {decay:g} gives no finite "
                f"exp((z - l) / m); {_ANOTHER}"
            )
        if amplitude := unit * n * math.exp(exponents[0]):  # 0 if it underflows
            values["impurity_exponential_1e10_per_cm3"] = amplitude
            values["impurity_exponential_length_mm"] = decay
    return values


def _number(
    values: Mapping[str, Any], place: str, source: str, default: float | None = None
) -> float:
    """Number at a location such as ``"slices.A.detector_offset_in_mm"``."""
    found: Any = values
    for key in place.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    if found is None and default is not None:
        return default
    if found is None:
        raise CpunetError(f"{source}: no {place}; {_ANOTHER}")
    number = isinstance(found, int | float) and not isinstance(found, bool)
    if not number or not math.isfinite(found):
        raise CpunetError(f"{source}: {place} = {found!r} is no number; {_ANOTHER}")
    return float(found)
