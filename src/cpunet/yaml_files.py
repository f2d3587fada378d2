"""What every reader of YAML and JSON needs: the package's own files by name, texts' fields."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources.abc import Traversable
from typing import Any

import yaml

from cpunet.errors import CpunetError


def yaml_names(folder: Traversable) -> list[str]:
    """Names, without the suffix, of the YAML files in a folder of the package."""
    return sorted(
        file.name.removesuffix(".yaml")
        for file in folder.iterdir()
        if file.name.endswith(".yaml")
    )


def parsed(text: str) -> Any:
    r"""What a text of YAML or JSON holds.

    Raises
    ------
    yaml.YAMLError
        If it is neither.

    Examples
    --------
    >>> parsed("bias_V: 4000"), parsed('{\n\t"bias_V": 4000\n}')
    ({'bias_V': 4000}, {'bias_V': 4000})
    """
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        # JSON may be indented by tabs, which YAML refuses
        try:
            return json.loads(text)
        except ValueError:
            pass
        raise


def yaml_fields(text: str, source: str, *, invalid: str, empty: str) -> dict[str, Any]:
    """Fields of a YAML text.

    Parameters
    ----------
    text
        YAML or JSON.
    source
        What the errors begin with, such as ``"detector V01.yaml"``.
    invalid, empty
        What they say of a text that is no YAML, and of one without fields.

    Raises
    ------
    CpunetError
        If the text is no mapping of fields.

    Examples
    --------
    >>> yaml_fields("bias_V: 4000", "detector V01", invalid="not YAML", empty="no fields")
    {'bias_V': 4000}
    """
    try:
        fields = parsed(text)
    except yaml.YAMLError as error:
        raise CpunetError(f"{source}: {invalid} ({' '.join(str(error).split())})") from error
    if not isinstance(fields, Mapping):
        raise CpunetError(f"{source}: {empty}")
    return dict(fields)
