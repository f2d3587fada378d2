r"""Detectors from files: YAML of this package, siggen configurations, LEGEND metadata.

LEGEND has diodes, and the crystals they were cut from. The ``impurity_curve`` of a crystal
describes the boule from which detectors were cut. As LegendDataManagement.jl reads it for
SolidStateDetectors.jl (its boule impurity densities), it gives the net acceptors in 1e9/cm3 as
a function of the distance :math:`z` from the seed end of the boule in mm,

.. math:: N(z) = a + b z + c z^2 + n\, e^{(z - l)/m}.

With ``corrections`` this becomes ``scale`` times the curve plus ``offset`` (1e9/cm3). The
``detector_offset_in_mm`` of a slice is the position of its point contact. From there the axis
of the detector runs back to the seed end.
"""

from __future__ import annotations

import logging
import math
import re
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cpunet.errors import CpunetError
from cpunet.settings import Set, checked, flat, key_values, names, read_text, read_values
from cpunet.simulation.geometry import Detector

log = logging.getLogger(__name__)

_FOLDER = Path(__file__).parent / "detectors"
_MAPPINGS = (".yaml", ".yml", ".json")
LIQUID_ARGON_K = 87.0  # around LEGEND's detectors, whose metadata tell no temperature
_SIGGEN_BYTES = 1 << 16

_KEYS: dict[str, Any] = read_values(Path(__file__).with_name("detector_keys.yaml"))
# parts of siggen's names of fields of the detector
_SIGGEN_PARTS = (("xtal_", "crystal_"), ("pc_", "point_contact_"), ("hole_", "bore_"))
# alternative or neutral values, and offsets of siggen's version in three dimensions
_DERIVED = re.compile(
    "bore_length_gap|(outer|inner)_taper_width|bulletize_PC|(point_contact|bore)_offset_.*"
)
_LEAST_POWER = 0.1
# settings of the drift, and names of the program's files
_NOT_OF_THE_DETECTOR = re.compile(
    "(drift|field|wp)_name|preamp_tau|time_steps_calc|step_time_(calc|out)|charge_cloud_size|"
    "use_diffusion|energy|verbosity(_level)?|max_iterations|write_(field|WP)|"
    "surface_drift_vel_factor"
)


_SIMULATED = ("icpc", "bege", "ppc")
_ANOTHER = "correct it, or take another file of the crystal"
_LARGEST_EXPONENT = 300


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
    if by_depletion := values.get("impurity_scale") == "depletion":
        del values["impurity_scale"]
    missing = {k: f"missing ({why}); give `settings` {k}=VALUE" for k, why in hints.items()}
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
        where = f"detector {name}: line {number}: {words[0]}"
        key = _KEYS["siggen"].get(words[0], words[0]).replace("_diam", "_radius")
        for theirs, ours in _SIGGEN_PARTS:
            key = key.replace(theirs, ours)
        if key not in Detector.model_fields and not _DERIVED.fullmatch(key):
            raise CpunetError(f"{where}: unknown key; neither siggen nor fieldgen has it")
        try:
            values[key] = float(words[1]) / (2 if words[0].endswith("_diam") else 1)
        except (IndexError, ValueError) as error:
            raise CpunetError(f"{where} has no number; give one") from error
        if "_offset_" in key and values[key]:
            raise CpunetError(
                f"{where} is not 0; only axially symmetric detectors are simulated"
            )
        if key == "bore_length_gap":
            values["bore_length"] = values.get("crystal_length", math.nan) - values[key]
    if values.get("bulletize_PC"):
        raise CpunetError(
            f"detector {name}: rounded point contacts are not simulated; set bulletize_PC to 0"
        )
    _fit(values, name)
    # siggen keeps the radius and the rounding of a hole that does not exist; without a power,
    # fieldgen has no radial terms
    has_terms = values.get("impurity_radial_power", 0.0) > _LEAST_POWER
    given = {"bore_": values.get("bore_length", 0.0) != 0, "impurity_radial": has_terms}
    absent = tuple(prefix for prefix, is_given in given.items() if not is_given)
    fields = Detector.model_fields
    return {k: v for k, v in values.items() if k in fields and not k.startswith(absent)}


def _fit(values: dict[str, float], name: str) -> None:
    """Widen tapers to their angle, if any, and cut sizes that exceed others, as siggen does.

    A taper that is cut keeps its width.
    """
    angle = values.get("taper_angle_deg", 0.0)
    widths = {side: values.get(f"{side}_taper_width", 0.0) for side in ("outer", "inner")}
    if angle:
        for side in widths:
            length = values.get(f"{side}_taper_length", 0.0)
            widths[side] = length * math.tan(math.radians(angle))
    around, ditch = values.get("wrap_around_radius", 0.0), values.get("ditch_thickness", 0.0)
    straight = values.get("bore_length", math.inf) - values.get("bore_bullet_radius", 0.0)
    most = {
        "inner_taper_length": ("hole_length - hole_bullet_radius", max(straight, 0.0)),
        "bore_bullet_radius": ("hole_radius", values.get("bore_radius", math.inf)),
    }
    if around and ditch and values.get("ditch_depth"):
        most["point_contact_radius"] = ("wrap_around_radius - ditch_thickness", around - ditch)
        if values.get("point_contact_radius") == 0:
            values["point_contact_radius"] = around - ditch
    for key, (limit, size) in most.items():
        if values.get(key, 0.0) > size:
            values[key] = size
            for theirs, ours in _SIGGEN_PARTS:
                key = key.replace(ours, theirs)
            log.info(f"detector {name}: {key} is {size:g} mm, as in siggen: at most {limit}")
    for side, field in (("outer", "taper_angle_deg"), ("inner", "inner_taper_angle_deg")):
        if length := values.get(f"{side}_taper_length", 0.0):
            own_angle = math.degrees(math.atan(widths[side] / length))
            if not math.isclose(own_angle, angle or math.nan):
                values[field] = own_angle
    wall = values.get("crystal_radius", math.inf) - values.get("bottom_taper_length", 0.0)
    if around >= wall and not values.get("ditch_depth"):
        values["wrap_around_radius"] = 0.0  # no wrap-around: lithium ends at the wall


def detector_values(
    diode: Mapping[str, Any], name: str
) -> tuple[dict[str, Any], dict[str, str]]:
    """Fields of `Detector` from a LEGEND diode, and reasons why it may not give one, by field.

    Bias, measured depletion voltage and lithium thickness (the full charge collection depth,
    FCCD) come from ``characterization``, where 0 means unknown. Impurities are those of the
    crystal in a file nearby, see `impurity_values`.

    Raises
    ------
    CpunetError
        If the geometry has an unknown key (for example, one without its unit), lacks one, or
        has a crack, which is not symmetric.
    """
    source, kind = f"detector {name}", diode.get("type")
    if kind is not None and kind not in _SIMULATED:  # semi-coaxial ones collect on their bore
        remedy = f"give one of type {', '.join(_SIMULATED)}"
        raise CpunetError(f"{source}: type {reprlib.repr(kind)} is not simulated", remedy)
    geometry = dict(flat(diode["geometry"]))
    cracked = any(key.startswith("extra.crack.") for key in geometry)
    if cracked and geometry.get("extra.crack.width_in_mm") != 0:
        raise CpunetError(
            f"{source}: geometry.extra.crack cuts off a side; only axially symmetric "
            "crystals are simulated; remove it to simulate the crystal without it"
        )
    values: dict[str, Any] = {"name": str(diode.get("name", Path(name).stem))}
    reasons = {field: f"no geometry.{key}" for key, field in _KEYS["diode"].items()}
    for key, value in geometry.items():
        if key == "extra" or key.startswith("extra.crack"):
            continue
        if key not in _KEYS["diode"]:
            text = f"{source}: unknown key geometry.{key} (units belong to the key)"
            raise CpunetError(text, "correct or remove it")
        values[_KEYS["diode"][key]] = value
    values.pop("", None)
    radii = [f"geometry.groove.radius_in_mm.{side}" for side in ("outer", "inner")]
    outer, inner = (_number_at(diode, place, source, 0.0) for place in radii)
    if geometry.get("groove.depth_in_mm"):
        values["ditch_thickness"] = outer - inner
    for field, places in _KEYS["measured"].items():
        reasons[field] = f"neither {' nor '.join(places)} is above 0"
        numbers = [_number_at(diode, place, source, 0.0) for place in places]
        if min(numbers) < 0:
            text = f"{source}: {places[numbers.index(min(numbers))]} is below 0"
            raise CpunetError(text, "correct it, or write 0 for none")
        if any(numbers):
            values[field] = next(filter(None, numbers))
    boule, cut = values["name"][:-1], values["name"][-1:]  # V99000 and A of V99000A
    slice_name = str((diode.get("production") or {}).get("slice") or cut)
    folder = Path(name).parent
    folders = folder.parent / "crystals", folder / "crystals", folder
    files = [place / f"{boule}{end}" for place in folders for end in _MAPPINGS]
    crystal = next(filter(Path.is_file, files), None)
    content: dict[str, Any] = read_values(crystal) if crystal else {}
    length = values.get("crystal_length")
    if content.get("impurity_curve") is None:
        reasons["impurity_z0_1e10_per_cm3"] = (
            f"{crystal} has no impurity_curve" if crystal else f"there is no {files[0]}"
        )
    elif isinstance(length, int | float):  # else refused with the rest of the geometry
        values |= impurity_values(content, str(crystal), slice_name, length)
    return values, reasons


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
    model, models = curve.get("model"), _KEYS["impurity_curve"]
    if not isinstance(model, str) or model not in models:
        text = f"{source}: impurity_curve.model {model!r} is unknown"
        raise CpunetError(f"{text}; models are {', '.join(models)}", _ANOTHER)
    numbers = dict.fromkeys("abcn", 0.0)
    for key in models[model]:
        value = _number_at(crystal, f"impurity_curve.parameters.{key}", source)
        numbers["a" if key == "value" else key] = value
    a, b, c, n = (numbers[key] for key in "abcn")
    place = f"slices.{slice_name}.detector_offset_in_mm"
    contact = _number_at(crystal, place, source)
    scale = _number_at(crystal, "impurity_curve.corrections.scale", source, 1.0)
    offset = _number_at(crystal, "impurity_curve.corrections.offset", source, 0.0)
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


def _number_at(
    values: Mapping[str, Any], place: str, source: str, default: float | None = None
) -> float:
    """Number at a location such as ``"slices.A.detector_offset_in_mm"``."""
    value: Any = values
    for key in place.split("."):
        if not isinstance(value, Mapping | None):
            raise CpunetError(f"{source}: {place}: {value!r} stands before {key}; {_ANOTHER}")
        value = value.get(key) if value else None
    if (value := default if value is None else value) is None:
        raise CpunetError(f"{source}: no {place}; {_ANOTHER}")
    if type(value) not in (int, float) or not math.isfinite(value):
        raise CpunetError(f"{source}: {place} = {value!r} is no number; {_ANOTHER}")
    return float(value)
