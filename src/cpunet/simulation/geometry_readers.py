"""Detectors from files: YAML of this package, siggen configurations, LEGEND metadata."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from cpunet.errors import CpunetError
from cpunet.settings import Set, checked, key_values, names, read_text, read_values
from cpunet.simulation.geometry import Detector
from cpunet.simulation.legend_crystal import LONGEST_MM, impurity_values
from cpunet.simulation.legend_metadata import (
    LIQUID_ARGON_K,
    crystal_and_slice,
    why_missing,
)
from cpunet.simulation.legend_metadata import detector_values as legend_values
from cpunet.simulation.siggen_config import detector_values as siggen_values

log = logging.getLogger(__name__)

_FOLDER = Path(__file__).parent / "detectors"
_MAPPINGS = (".yaml", ".yml", ".json")
_SIGGEN_BYTES = 1 << 16
_Z0 = "impurity_z0_1e10_per_cm3"

# reasons why a file does not give a field
_Hints = dict[str, str]


def detector_names() -> list[str]:
    """Names of the preset detectors."""
    return names(_FOLDER)


def read_detector(
    path: str | Path | Detector, overrides: Set = (), crystal: str | Path | None = None
) -> Detector:
    """Read a detector and apply overrides.

    Parameters
    ----------
    path
        Name of a preset (see `detector_names`), a YAML or JSON file with the fields of
        `Detector`, a LEGEND diode (YAML or JSON with a ``geometry``), or, with any other
        suffix, a siggen or fieldgen configuration. Or a detector, for overrides.
    overrides
        Values as ``"bias_V=3500"``. They also supply fields that a file lacks. LEGEND diodes,
        which tell no ``temperature_K``, are at that of liquid argon unless it is given.
        ``"impurity_scale=depletion"`` (or in the file) scales the impurities so that the
        detector depletes at its ``measured_depletion_V``.
    crystal
        LEGEND file of the crystal from which a diode was cut, with its impurities. By
        default ``crystals/V99000.yaml`` next to the folder of ``V99000A.yaml``.

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
    given = key_values(overrides)
    if isinstance(path, Detector):
        if not given:
            return path
        return _completed(path.model_dump(), given, path.name, {})
    name = str(path)
    hints: _Hints = {}
    if name in detector_names() or Path(path).suffix.lower() in _MAPPINGS:
        values = read_values(path, _FOLDER)
    else:
        values = siggen_values(read_text(path, _FOLDER), name)
    if "geometry" in values:
        values, hints = _legend(values, Path(path), crystal)
        if "temperature_K" not in given:
            values["temperature_K"] = LIQUID_ARGON_K
            log.info(f"{name}: tells no temperature; {LIQUID_ARGON_K:g} K, as in liquid argon")
    elif crystal is not None:
        raise CpunetError(
            f"{name}: only LEGEND metadata take their impurities from another file; leave out "
            "`crystal`"
        )
    return _completed({"name": Path(name).stem} | values, given, name, hints)


def _completed(
    values: dict[str, Any], given: dict[str, Any], name: str, hints: _Hints
) -> Detector:
    """The detector of some values, overridden by those given; see `read_detector`."""
    values = values | given
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
    if not _is_file(place):
        return False
    with place.open("rb") as file:
        return b"xtal_length" in file.read(_SIGGEN_BYTES)


def _legend(
    diode: dict[str, Any], path: Path, crystal: str | Path | None
) -> tuple[dict[str, Any], _Hints]:
    """Values of a LEGEND diode and its crystal, and reasons why some are missing."""
    values = legend_values(diode, str(path))
    crystal_name, slice_name = crystal_and_slice(diode, path.stem)
    places = [
        folder / f"{crystal_name}{suffix}"
        for folder in (path.parent.parent / "crystals", path.parent / "crystals", path.parent)
        for suffix in _MAPPINGS
    ]
    found = Path(crystal) if crystal else next(filter(_is_file, places), None)
    hints = {field: why for field in Detector.model_fields if (why := why_missing(field))}
    hints[_Z0] = f"production.impcc is empty or 0, and there is no {places[0]}"
    if found is None:
        return values, hints
    content = read_values(found)
    hints[_Z0] = f"production.impcc is empty or 0, and {found} has no impurity_curve"
    if content.get("impurity_curve") is None and crystal is None:
        return values, hints
    length = values["crystal_length"]
    if not isinstance(length, int | float) or length > LONGEST_MM:
        return values, hints  # refused together with the rest of the geometry
    # the curve describes the whole crystal and replaces a line through a few points
    values = {key: value for key, value in values.items() if not key.startswith("impurity_")}
    return values | impurity_values(content, str(found), slice_name, length), hints


def _is_file(path: Path) -> bool:
    """Whether there is such a file; False for names that no file can have."""
    try:
        return path.is_file()
    except OSError:
        return False
