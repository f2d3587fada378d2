"""Detectors from files: YAML of this package, siggen configurations, LEGEND metadata."""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path
from typing import Any

from cpunet.errors import CpunetError
from cpunet.settings import Set, checked, key_values, names, read_text, read_values
from cpunet.simulation.geometry import Detector
from cpunet.simulation.legend_metadata import detector_values

log = logging.getLogger(__name__)

_FOLDER = Path(__file__).parent / "detectors"
_MAPPINGS = (".yaml", ".yml", ".json")
LIQUID_ARGON_K = 87.0  # around LEGEND's detectors, whose metadata tell no temperature
_SIGGEN_BYTES = 1 << 16

# siggen's names of fields of the detector; parts of the names, then whole names
_SIGGEN_PARTS = (("xtal_", "crystal_"), ("pc_", "point_contact_"), ("hole_", "bore_"))
_SIGGEN_NAMES = {
    "taper_angle": "taper_angle_deg",
    "Li_thickness": "li_thickness",
    "impurity_z0": "impurity_z0_1e10_per_cm3",
    "impurity_gradient": "impurity_gradient_1e10_per_cm4",
    "impurity_quadratic": "impurity_quadratic_1e10_per_cm3",
    "impurity_surface": "surface_charge_1e10_per_cm2",
    "impurity_radial_add": "impurity_radial_add_1e10_per_cm3",
    "impurity_rpower": "impurity_radial_power",
    "xtal_HV": "bias_V",
    "xtal_temp": "temperature_K",
    "xtal_grid": "grid_mm",
}
# alternative or neutral values, evaluated below
_DERIVED = ("hole_length_gap", "outer_taper_width", "inner_taper_width", "bulletize_PC")
# of siggen's version in three dimensions
_OFFSETS = ("pc_offset_", "hole_offset_")
_LEAST_POWER = 0.1
# settings of the drift, and names of the program's files
_NOT_OF_THE_DETECTOR = re.compile(
    "(drift|field|wp)_name|preamp_tau|time_steps_calc|step_time_(calc|out)|charge_cloud_size|"
    "use_diffusion|energy|verbosity(_level)?|max_iterations|write_(field|WP)|"
    "surface_drift_vel_factor"
)


def detector_names() -> list[str]:
    """Names of the preset detectors."""
    return names(_FOLDER)


def read_detector(path: str | Path | Detector, overrides: Set = ()) -> Detector:
    """Read a detector and apply overrides.

    Parameters
    ----------
    path
        Name of a preset (see `detector_names`), a YAML or JSON file with the fields of
        `Detector`, a LEGEND diode (YAML or JSON with a ``geometry``; its impurities are those
        of ``crystals/V99000.yaml`` next to the folder of ``V99000A.yaml``), or, with any other
        suffix, a siggen or fieldgen configuration. Or a detector, for overrides.
    overrides
        Values as ``"bias_V=3500"``. They also supply fields that a file lacks. LEGEND diodes,
        which tell no ``temperature_K``, are at that of liquid argon unless it is given.
        ``"impurity_scale=depletion"`` (or in the file) scales the impurities so that the
        detector depletes at its ``measured_depletion_V``.

    Raises
    ------
    CpunetError
        If a file cannot be read or the detector is invalid.

    Examples
    --------
    >>> detector = read_detector("icpc", ["bias_V=3500"])
    >>> detector.crystal_length, detector.bias_V
    (96.0, 3500.0)
    """
    given, name = key_values(overrides), str(path)
    values: dict[str, Any]
    hints: dict[str, str] = {}
    if isinstance(path, Detector):
        name, values = path.name, path.model_dump()
    elif name in detector_names() or Path(path).suffix.lower() in _MAPPINGS:
        values = {"name": Path(name).stem} | read_values(path, _FOLDER)
    else:
        values = {"name": Path(name).stem} | siggen_values(read_text(path, _FOLDER), name)
    if "geometry" in values:
        values, hints = detector_values(values, name)
        if "temperature_K" not in given:
            values["temperature_K"] = LIQUID_ARGON_K
            log.info(f"{name}: tells no temperature; {LIQUID_ARGON_K:g} K, as in liquid argon")
    values |= given
    by_depletion = values.get("impurity_scale") == "depletion"
    if by_depletion:
        del values["impurity_scale"]
    missing = {
        key: f"missing ({why}); give `settings` {key}=VALUE" for key, why in hints.items()
    }
    detector = checked(Detector, values, name, missing)
    if not by_depletion:
        return detector
    from cpunet.simulation.fields import scaled_to_depletion  # solves for the fields

    return scaled_to_depletion(detector)


def holds_detector(path: str | Path) -> bool:
    """Whether `read_detector` reads it: a preset's name, YAML, JSON, or siggen's file."""
    place = Path(path)
    if str(path) in detector_names() or place.suffix.lower() in _MAPPINGS:
        return True
    if not place.is_file():
        return False
    with place.open("rb") as file:
        return b"xtal_length" in file.read(_SIGGEN_BYTES)


def siggen_values(text: str, name: str) -> dict[str, float]:
    r"""Fields of `Detector` from the content `text` of siggen's configuration file `name`.

    It is read as siggen does: a key stands at the beginning of its line (others are comments),
    the last line of a key counts, a ``_diam`` is twice the ``_radius``, and sizes that do not
    fit in each other are cut.

    Raises
    ------
    CpunetError
        If a key is unknown or has no number, or an offset makes the detector asymmetric.

    Examples
    --------
    >>> siggen_values("xtal_length 96.0  # mm\nxtal_HV 4000\n", "V.config")
    {'crystal_length': 96.0, 'bias_V': 4000.0}
    """
    values: dict[str, float] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words or line[0] in " \t" or _NOT_OF_THE_DETECTOR.fullmatch(words[0]):
            continue
        where, key = f"detector {name}: line {number}: {words[0]}", words[0]
        key = {"taper_length": "bottom_taper_length"}.get(key, key).replace("_diam", "_radius")
        if not (_field_of(key) or key in _DERIVED or key.startswith(_OFFSETS)):
            raise CpunetError(f"{where}: unknown key; neither siggen nor fieldgen has it")
        try:
            values[key] = float(words[1]) / (2 if words[0].endswith("_diam") else 1)
        except (IndexError, ValueError) as error:
            raise CpunetError(f"{where} has no number; give one") from error
        if key.startswith(_OFFSETS) and values.pop(key):
            raise CpunetError(
                f"{where} is not 0; only axially symmetric detectors are simulated"
            )
        if key == "hole_length_gap":
            values["hole_length"] = values.get("xtal_length", math.nan) - values[key]
    if values.get("bulletize_PC"):
        raise CpunetError(
            f"detector {name}: rounded point contacts are not simulated; set bulletize_PC to 0"
        )
    _fit(values, name)
    fields = {field: value for key, value in values.items() if (field := _field_of(key))}
    for side, angle in (("outer", "taper_angle_deg"), ("inner", "inner_taper_angle_deg")):
        width, length = (values.get(f"{side}_taper_{x}", 0.0) for x in ("width", "length"))
        own_angle = math.degrees(math.atan(width / length)) if length else math.nan
        if length and not math.isclose(own_angle, values.get("taper_angle") or math.nan):
            fields[angle] = own_angle
    # siggen keeps the radius and the rounding of a hole that does not exist
    if not fields.get("bore_length"):
        fields = {k: v for k, v in fields.items() if not k.startswith("bore_")}
    # without a power, fieldgen has no radial terms
    if not values.get("impurity_rpower", 0.0) > _LEAST_POWER:
        fields = {k: v for k, v in fields.items() if not k.startswith("impurity_radial")}
    return fields


def _field_of(key: str) -> str:
    """Field of `Detector` of a key of siggen, ``""`` if there is none."""
    field = _SIGGEN_NAMES.get(key, key)
    for theirs, ours in _SIGGEN_PARTS:
        field = field.replace(theirs, ours)
    return field if field in Detector.model_fields else ""


def _fit(values: dict[str, float], name: str) -> None:
    """Widen tapers to their angle, if any, and cut sizes that exceed others, as siggen does."""
    if angle := values.get("taper_angle"):
        for side in ("outer", "inner"):
            length = values.get(f"{side}_taper_length", 0.0)
            values[f"{side}_taper_width"] = length * math.tan(math.radians(angle))
    around, ditch = values.get("wrap_around_radius", 0.0), values.get("ditch_thickness", 0.0)
    straight = values.get("hole_length", math.inf) - values.get("hole_bullet_radius", 0.0)
    most = {  # a taper that is cut keeps its width
        "inner_taper_length": ("hole_length - hole_bullet_radius", max(straight, 0.0)),
        "hole_bullet_radius": ("hole_radius", values.get("hole_radius", math.inf)),
    }
    if around and ditch and values.get("ditch_depth"):
        inside = around - ditch
        most["pc_radius"] = ("wrap_around_radius - ditch_thickness", inside)
        if values.get("pc_radius") == 0:
            values["pc_radius"] = inside
    for key, (limit, size) in most.items():
        if values.get(key, 0.0) > size:
            log.info(f"detector {name}: {key} is {size:g} mm, as in siggen: at most {limit}")
            values[key] = size
    flat = values.get("xtal_radius", math.inf) - values.get("bottom_taper_length", 0.0)
    if around >= flat and not values.get("ditch_depth"):
        values["wrap_around_radius"] = 0.0  # no wrap-around: lithium ends at the wall
