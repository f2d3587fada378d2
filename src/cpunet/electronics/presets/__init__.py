"""Readout chains from YAML files: the presets of the package and the user's own."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cpunet.electronics.chain import Electronics
from cpunet.errors import CpunetError
from cpunet.regular_files import read_text
from cpunet.yaml_files import MAX_BYTES, shown, yaml_fields, yaml_names

_FOLDER = files("cpunet.electronics.presets")


def electronics_names() -> list[str]:
    """Names of the preset readout chains.

    Examples
    --------
    >>> electronics_names()
    ['legend200', 'ornl', 'ringing']
    """
    return yaml_names(_FOLDER)


def read_electronics(path: str | Path) -> Electronics:
    """Read a readout chain.

    Parameters
    ----------
    path
        Name of a preset (see `electronics_names`) or a YAML file with the fields of
        `Electronics`.

    Raises
    ------
    CpunetError
        If the file cannot be read or the chain is invalid. The message names the field.

    Examples
    --------
    >>> read_electronics("ornl").decays[0].tau_us
    54.6
    """
    name = str(path)
    if name in electronics_names():
        text = (_FOLDER / f"{name}.yaml").read_text("utf-8")
    else:
        text = _text(Path(path))
    values = yaml_fields(
        text,
        f"electronics {name}",
        invalid="not YAML",
        empty="holds no fields; write lines such as dt_ns: 16",
    )
    try:
        return Electronics.model_validate(values)
    except ValidationError as error:
        raise CpunetError(f"electronics {name}: {_first_problem(error)}") from error


def _text(path: Path) -> str:
    try:
        return read_text(path, MAX_BYTES)
    except FileNotFoundError as error:
        raise CpunetError(
            f"electronics {path}: neither a file nor one of {', '.join(electronics_names())}"
        ) from error
    except OSError as error:
        raise CpunetError(
            f"electronics {path}: cannot be read ({error.strerror or error})"
        ) from error


def _first_problem(error: ValidationError) -> str:
    first: Any = error.errors(include_url=False)[0]
    key = ".".join(map(str, first["loc"]))
    if first["type"] == "missing":
        return f"no {key}; add it to the file"
    if first["type"] == "extra_forbidden":
        return f"unknown key {key}; remove or correct it"
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "value_error":
        return f"{key}: {message}" if key else message
    return f"{key} = {shown(first['input'])}: {message[0].lower()}{message[1:]}; correct it"
