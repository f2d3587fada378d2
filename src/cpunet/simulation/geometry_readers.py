"""Detectors from files: this package's YAML, siggen configurations, LEGEND metadata."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from cpunet.errors import CpunetError
from cpunet.simulation.geometry import Detector
from cpunet.simulation.legend_metadata import detector_values as legend_values
from cpunet.simulation.siggen_config import detector_values as siggen_values
from cpunet.yaml_files import yaml_fields, yaml_names

_FOLDER = files("cpunet.simulation") / "detectors"
_MAPPINGS = (".yaml", ".yml", ".json")


def detector_names() -> list[str]:
    """Names of the detectors that come with the package."""
    return yaml_names(_FOLDER)


def read_detector(path: str | Path, overrides: Iterable[str] = ()) -> Detector:
    """Read a detector, and add or override single values.

    Parameters
    ----------
    path
        One of `detector_names`; a YAML or JSON file with the fields of `Detector`; a
        LEGEND diode (YAML or JSON, with a ``geometry``), or, by any other suffix, a
        siggen or fieldgen configuration.
    overrides
        ``"bias_V=3500"`` and the like.  They also give what a file does not hold: most
        LEGEND diodes lack ``temperature_K``, some the impurities.

    Raises
    ------
    CpunetError
        If the file cannot be read, or the detector is impossible.

    Examples
    --------
    >>> detector = read_detector("icpc", ["bias_V=3500"])
    >>> detector.crystal_length, detector.bias_V
    (96.0, 3500.0)
    """
    name = str(path)
    if name in detector_names():
        values = _mapping((_FOLDER / f"{name}.yaml").read_text("utf-8"), name)
    else:
        values = _from_file(Path(path))
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise CpunetError(f"detector {name}: {override!r} is no KEY=VALUE")
        try:
            values[key.strip()] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise CpunetError(f"detector {name}: {override!r} has no plain value") from error
    try:
        return Detector.model_validate({"name": Path(name).stem, **values})
    except ValidationError as error:
        raise CpunetError(f"detector {name}: {_first_problem(error)}") from error


def _from_file(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise CpunetError(
            f"detector {path}: neither a file nor one of {', '.join(detector_names())}"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise CpunetError(f"detector {path}: cannot be read as text ({error})") from error
    if path.suffix.lower() not in _MAPPINGS:
        return siggen_values(text, str(path))
    values = _mapping(text, str(path))
    return legend_values(values, str(path)) if "geometry" in values else values


def _mapping(text: str, name: str) -> dict[str, Any]:
    return yaml_fields(
        text,
        f"detector {name}",
        invalid="no valid YAML or JSON",
        empty="holds no keys; see the examples in detectors/",
    )


def _first_problem(error: ValidationError) -> str:
    """The first of pydantic's complaints in a line that names the key."""
    first = error.errors(include_url=False)[0]
    key = ".".join(map(str, first["loc"]))
    if first["type"] == "missing":
        return f"no {key}; add it to the file, or give {key}=VALUE"
    if first["type"] == "extra_forbidden":
        return f"unknown key {key}; known are {', '.join(Detector.model_fields)}"
    message = first["msg"].removeprefix("Value error, ")
    if not key:
        return f"{message}; correct these values"
    return f"{key} = {first['input']!r}: {message[0].lower()}{message[1:]}"
