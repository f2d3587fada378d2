"""Settings of a simulation from a YAML file and from single values on top."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cpunet.errors import CpunetError
from cpunet.simulation.settings import SimulationSettings
from cpunet.yaml_files import yaml_fields


def load_settings(
    path: Path | None = None, values: Mapping[str, Any] | None = None
) -> SimulationSettings:
    """Read settings; what neither the file nor `values` gives keeps its default.

    Parameters
    ----------
    path
        YAML file with fields of `SimulationSettings`.
    values
        Fields that go before those of the file; None leaves a field as it is.

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


def _mapping(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not text"
        raise CpunetError(f"{path}: cannot be read ({reason}); give a YAML file") from error
    return yaml_fields(
        text,
        str(path),
        invalid="not YAML",
        empty="holds no settings; write lines such as dt_ns: 16",
    )
