"""What every reader of YAML and JSON needs: the package's own files by name, texts' fields.

Texts come from anyone: they may be nested without end, or hold numbers of thousands of digits.
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping
from importlib.resources.abc import Traversable
from typing import Any

import yaml

from cpunet.errors import CpunetError

MOST_BYTES = 10_000_000  # of a text of settings
_MOST_DEPTH = 50
_MOST_VALUES = 200_000  # references counted as often as they are made
_MOST_NUMBER = 10**60  # beyond, no whole number means anything here


def yaml_names(folder: Traversable) -> list[str]:
    """Names, without the suffix, of the YAML files in a folder of the package."""
    return sorted(
        file.name.removesuffix(".yaml")
        for file in folder.iterdir()
        if file.name.endswith(".yaml")
    )


class _Loader(yaml.SafeLoader):
    """Plain values: what looks like a date is text, as no setting is a date."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in found if not tag.endswith(":timestamp")]
    for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parsed(text: str) -> Any:
    r"""What a text of YAML or JSON holds.

    Raises
    ------
    yaml.YAMLError
        If it is neither, or nested too deeply, or holds numbers beyond all reason.

    Examples
    --------
    >>> parsed("bias_V: 4000"), parsed('{\n\t"bias_V": 4000\n}')
    ({'bias_V': 4000}, {'bias_V': 4000})
    """
    try:
        return _yaml(text)
    except yaml.YAMLError:
        # JSON may be indented by tabs, which YAML refuses
        try:
            return plain_json(text)
        except ValueError:
            pass
        raise


def plain_json(text: str | bytes) -> Any:
    """What a text of JSON holds.

    Raises
    ------
    ValueError
        If it is none, or nested too deeply, or holds numbers beyond all reason.
    """
    if len(text) > MOST_BYTES:
        raise ValueError(f"larger than {MOST_BYTES / 1e6:g} MB")
    try:
        found = json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    _require_plain(found)
    return found


def shown(value: Any) -> str:
    """A value for a message, shortened if it is long.

    Examples
    --------
    >>> shown(4000), shown(list(range(99)))
    ('4000', '[0, 1, 2, 3, 4, 5, ...]')
    """
    text = " ".join(_SHORT.repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


_SHORT = reprlib.Repr()
_SHORT.maxdict = _SHORT.maxlevel = 4
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60


def _yaml(text: str) -> Any:
    if len(text) > MOST_BYTES:
        raise yaml.YAMLError(f"larger than {MOST_BYTES / 1e6:g} MB")
    try:
        depth = 0
        for event in yaml.parse(text, _Loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _MOST_DEPTH:
                raise ValueError("nested too deeply")
        found = yaml.load(text, _Loader)
        _require_plain(found)
    except yaml.YAMLError:
        raise
    except Exception as error:  # whatever a value is that only looks like a number
        raise yaml.YAMLError(str(error) or type(error).__name__) from error
    return found


def _require_plain(value: Any) -> None:
    """Raise a `ValueError` for a value with too many parts, too deep, or too large a number."""
    ahead, met = [(value, 0)], 0
    while ahead:
        part, depth = ahead.pop()
        met += 1
        if met > _MOST_VALUES:
            raise ValueError("too many values")
        if depth > _MOST_DEPTH:
            raise ValueError("nested too deeply")
        if isinstance(part, int) and abs(part) > _MOST_NUMBER:
            raise ValueError("a whole number of more than 60 digits")
        if isinstance(part, Mapping):
            ahead += [(inner, depth + 1) for pair in part.items() for inner in pair]
        elif isinstance(part, list | tuple | set):
            ahead += [(inner, depth + 1) for inner in part]


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
        said = " ".join(str(error).split())
        raise CpunetError(f"{source}: {invalid} ({said[:200]})") from error
    if not isinstance(fields, Mapping):
        raise CpunetError(f"{source}: {empty}")
    return dict(fields)
