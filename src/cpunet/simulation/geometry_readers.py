"""Detectors from files: YAML of this package, siggen configurations, LEGEND metadata."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cpunet.errors import CpunetError
from cpunet.regular_files import read_text
from cpunet.simulation.geometry import Detector
from cpunet.simulation.legend_crystal import LONGEST_MM, impurity_values
from cpunet.simulation.legend_metadata import crystal_and_slice, why_missing
from cpunet.simulation.legend_metadata import detector_values as legend_values
from cpunet.simulation.siggen_config import detector_values as siggen_values
from cpunet.yaml_files import MAX_BYTES, key_and_value, shown, yaml_fields, yaml_names

_FOLDER = files("cpunet.simulation") / "detectors"
_MAPPINGS = (".yaml", ".yml", ".json")
_Z0 = "impurity_z0_1e10_per_cm3"

# reasons why a file does not give a field
_Hints = dict[str, str]


def detector_names() -> list[str]:
    """Names of the preset detectors."""
    return yaml_names(_FOLDER)


def read_detector(
    path: str | Path, overrides: Iterable[str] = (), crystal: str | Path | None = None
) -> Detector:
    """Read a detector and apply overrides.

    Parameters
    ----------
    path
        Name of a preset (see `detector_names`), a YAML or JSON file with the fields of
        `Detector`, a LEGEND diode (YAML or JSON with a ``geometry``), or, with any other
        suffix, a siggen or fieldgen configuration.
    overrides
        Values as ``"bias_V=3500"``. They also supply fields that a file lacks, such as
        ``temperature_K`` of LEGEND diodes.
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
    name = str(path)
    hints: _Hints = {}
    if name in detector_names():
        values = _mapping((_FOLDER / f"{name}.yaml").read_text("utf-8"), f"detector {name}")
    else:
        values = _from_file(Path(path))
    if "geometry" in values:
        values, hints = _legend(values, Path(path), crystal)
    elif crystal is not None:
        raise CpunetError(
            f"detector {name}: only LEGEND metadata take their impurities from another "
            "file; leave out --crystal"
        )
    for override in overrides:
        pair = key_and_value(override, f"detector {name}")
        if pair is None:
            raise CpunetError(f"detector {name}: {shown(override)} is no KEY=VALUE")
        values |= [pair]
    try:
        return Detector.model_validate({"name": Path(name).stem, **values})
    except ValidationError as error:
        raise CpunetError(f"detector {name}: {_first_problem(error, hints)}") from error


def _from_file(path: Path) -> dict[str, Any]:
    try:
        text = read_text(path, MAX_BYTES)
    except FileNotFoundError as error:
        raise CpunetError(
            f"detector {path}: neither a file nor one of {', '.join(detector_names())}"
        ) from error
    except OSError as error:
        raise CpunetError(f"detector {path}: cannot be read ({error.strerror})") from error
    if path.suffix.lower() not in _MAPPINGS:
        return siggen_values(text, str(path))
    return _mapping(text, f"detector {path}")


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
    try:
        text = read_text(found, MAX_BYTES)
    except OSError as error:
        raise CpunetError(f"crystal {found}: cannot be read ({error.strerror})") from error
    content = _mapping(text, f"crystal {found}")
    hints[_Z0] = f"production.impcc is empty or 0, and {found} has no impurity_curve"
    if content.get("impurity_curve") is None and crystal is None:
        return values, hints
    length = values["crystal_length"]
    if not isinstance(length, int | float) or length > LONGEST_MM:
        return values, hints  # refused together with the rest of the geometry
    # the curve describes the whole crystal and replaces a line through a few points
    values = {key: value for key, value in values.items() if not key.startswith("impurity_")}
    return values | impurity_values(content, f"crystal {found}", slice_name, length), hints


def _is_file(path: Path) -> bool:
    """Whether there is such a file; False for names that no file can have."""
    try:
        return path.is_file()
    except OSError:
        return False


def _mapping(text: str, source: str) -> dict[str, Any]:
    return yaml_fields(
        text,
        source,
        invalid="no valid YAML or JSON",
        empty="holds no keys; see the examples in detectors/",
    )


def _first_problem(error: ValidationError, hints: _Hints) -> str:
    """First problem reported by pydantic, in one line that names the key."""
    first = error.errors(include_url=False)[0]
    key = ".".join(map(str, first["loc"]))
    if first["type"] == "missing" and key in hints:
        crystal = "give the crystal's file with --crystal, or " if key == _Z0 else "give "
        return f"no {key} ({hints[key]}); {crystal}--set {key}=VALUE"
    if first["type"] == "missing":
        return f"no {key}; add it to the file, or give {key}=VALUE"
    if first["type"] == "extra_forbidden":
        return f"unknown key {shown(key)[1:-1]}; known are {', '.join(Detector.model_fields)}"
    message = first["msg"].removeprefix("Value error, ")
    if not key:
        return f"{message}; correct these values"
    return f"{key} = {shown(first['input'])}: {message[0].lower()}{message[1:]}"
