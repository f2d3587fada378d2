"""Common functions for YAML and JSON: files of the package by name, and fields of a text.

The texts are untrusted: they can be nested without limit or contain numbers of thousands of
digits.
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import yaml

from cpunet.errors import CpunetError
from cpunet.regular_files import read_text

MAX_BYTES = 10_000_000  # of a settings file
_MAX_DEPTH = 50
_MAX_VALUES = 200_000  # every reference counts
_MAX_NUMBER = 10**60  # larger integers are meaningless here


def yaml_names(folder: Traversable) -> list[str]:
    """Names of the YAML files in a folder of the package, without the suffix."""
    return sorted(
        file.name.removesuffix(".yaml")
        for file in folder.iterdir()
        if file.name.endswith(".yaml")
    )


class _Loader(yaml.SafeLoader):
    """Loader of plain values; dates are kept as text, since no setting is a date."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in found if not tag.endswith(":timestamp")]
    for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parsed(text: str) -> Any:
    r"""Parse a YAML or JSON text.

    Raises
    ------
    yaml.YAMLError
        If the text is neither, is nested too deeply, or contains unreasonably large numbers.

    Examples
    --------
    >>> parsed("bias_V: 4000"), parsed('{\n\t"bias_V": 4000\n}')
    ({'bias_V': 4000}, {'bias_V': 4000})
    """
    try:
        return _yaml(text)
    except yaml.YAMLError:
        # JSON can be indented with tabs, which YAML refuses
        try:
            return plain_json(text)
        except ValueError:
            pass
        raise


def key_and_value(word: str, source: str) -> tuple[str, Any] | None:
    """Key and parsed value of a ``KEY=VALUE``; None if there is no ``=``.

    Parameters
    ----------
    word
        As given by the user.
    source
        Start of error messages, such as ``"detector V01"``.

    Raises
    ------
    CpunetError
        If the value cannot be parsed.

    Examples
    --------
    >>> key_and_value("bias_V = 4000", "detector V01"), key_and_value("V01.yaml", "shift")
    (('bias_V', 4000), None)
    """
    key, equals, value = word.partition("=")
    if not equals:
        return None
    try:
        return key.strip(), parsed(value)
    except yaml.YAMLError as error:
        raise CpunetError(f"{source}: {shown(word)} has no plain value") from error


def plain_json(text: str | bytes) -> Any:
    """Parse a JSON text.

    Raises
    ------
    ValueError
        If the text is not JSON, is nested too deeply, or contains unreasonably large numbers.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES / 1e6:g} MB")
    try:
        found = json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    _require_plain(found)
    return found


def json_mapping(path: Path, absent: str, remedy: str) -> dict[str, Any]:
    """Read a mapping from a JSON file.

    Parameters
    ----------
    absent
        Error message if the file cannot be read.
    remedy
        What to do if it is damaged.
    """
    try:
        content = plain_json(read_text(path, MAX_BYTES))
    except OSError as error:
        raise CpunetError(absent) from error
    except ValueError as error:
        raise CpunetError(f"{path}: damaged ({error}); {remedy}") from error
    if not isinstance(content, dict):
        raise CpunetError(f"{path}: damaged (no mapping); {remedy}")
    return content


def shown(value: Any) -> str:
    """Format a value for a message, shortened if it is long.

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
    if len(text) > MAX_BYTES:
        raise yaml.YAMLError(f"larger than {MAX_BYTES / 1e6:g} MB")
    try:
        depth = 0
        for event in yaml.parse(text, _Loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_DEPTH:
                raise ValueError("nested too deeply")
        found = yaml.load(text, _Loader)
        _require_plain(found)
    except yaml.YAMLError:
        raise
    except Exception as error:  # values that only look like numbers raise various errors
        raise yaml.YAMLError(str(error) or type(error).__name__) from error
    return found


def _require_plain(value: Any) -> None:
    """Raise a `ValueError` if a value is too large or too deep, or has too large a number."""
    ahead, met = [(value, 0)], 0
    while ahead:
        part, depth = ahead.pop()
        met += 1
        if met > _MAX_VALUES:
            raise ValueError("too many values")
        if depth > _MAX_DEPTH:
            raise ValueError("nested too deeply")
        if isinstance(part, int) and abs(part) > _MAX_NUMBER:
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
        YAML or JSON text.
    source
        Start of error messages, such as ``"detector V01.yaml"``.
    invalid, empty
        Error messages for a text that is not YAML, and for one without fields.

    Raises
    ------
    CpunetError
        If the text is not a mapping of fields.

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
