"""Read settings of a simulation from a YAML file and single values that override it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cpunet.errors import CpunetError
from cpunet.regular_files import read_text
from cpunet.simulation.settings import SimulationSettings
from cpunet.yaml_files import MAX_BYTES, key_and_value, yaml_fields


def load_settings(
    path: Path | None = None, values: Mapping[str, Any] | None = None
) -> SimulationSettings:
    """Read settings; fields in neither the file nor `values` keep their defaults.

    Parameters
    ----------
    path
        YAML file with fields of `SimulationSettings`.
    values
        Fields that override those of the file; None leaves a field unchanged.

    Raises
    ------
    CpunetError
        If the file cannot be read, or a field or value is not allowed.

    Examples
    --------
    >>> load_settings(values={"dt_ns": 10, "diffusion": None}).dt_ns
    10.0
    """
    content: dict[str, Any] = {} if path is None else _mapping(path)
    content |= {name: value for name, value in (values or {}).items() if value is not None}
    try:
        return SimulationSettings.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        message = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            message = f"no such setting; there are {', '.join(SimulationSettings.model_fields)}"
        where = "settings" if path is None else str(path)
        raise CpunetError(f"{where}: {f'{key}: ' if key else ''}{message}") from error


def split_overrides(overrides: Iterable[str]) -> tuple[list[str], dict[str, Any]]:
    """Split ``KEY=VALUE`` words into those of the detector, and values of settings by key.

    Raises
    ------
    CpunetError
        If the value of a setting cannot be parsed.

    Examples
    --------
    >>> split_overrides(["bias_V=3500", "hole_trapping_per_us=0.01"])
    (['bias_V=3500'], {'hole_trapping_per_us': 0.01})
    """
    detector: list[str] = []
    settings: dict[str, Any] = {}
    for word in overrides:
        of_settings = word.partition("=")[0].strip() in SimulationSettings.model_fields
        pair = key_and_value(word, "settings") if of_settings else None
        if pair is None:
            detector.append(word)
        else:
            settings |= [pair]
    return detector, settings


def _mapping(path: Path) -> dict[str, Any]:
    try:
        text = read_text(path, MAX_BYTES)
    except OSError as error:
        reason = error.strerror or error
        raise CpunetError(f"{path}: cannot be read ({reason}); give a YAML file") from error
    return yaml_fields(
        text,
        str(path),
        invalid="not YAML",
        empty="holds no settings; write lines such as dt_ns: 16",
    )
