"""Settings: their base class, reading them by name or from a file, and plain values."""

from __future__ import annotations

import difflib
import json
import re
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeAlias, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import to_jsonable_python

from cpunet.errors import CpunetError

Positive = Annotated[float, Field(gt=0, le=1e30)]
NonNegative = Annotated[float, Field(ge=0, le=1e30)]
Millimetres = Annotated[float, Field(ge=0, le=1000)]
# Upper limits are far above any realistic value, but not beyond memory and computing time.
Count = Annotated[int, Field(ge=1, le=100_000_000)]
Samples = Annotated[int, Field(ge=1, le=100_000)]
Width = Annotated[int, Field(ge=1, le=4096)]
Fraction = Annotated[float, Field(ge=0, lt=1)]


class _Loader(yaml.SafeLoader):
    """YAML 1.2, in which 4.4e3 and 1e-05 are numbers, and 010 is ten."""

    yaml_implicit_resolvers: ClassVar[Any] = {}  # type: ignore[misc]


class _Dumper(yaml.SafeDumper):
    """Quotes text that readers of YAML 1.1 or 1.2 would take for something else."""


_CORE = {  # scalars of the core schema, with the characters that they begin with
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    "bool": (r"true|True|TRUE|false|False|FALSE", [*"tTfF"]),
    "int": (r"[-+]?[0-9][0-9_]*|0o[0-7]+|0x[0-9a-fA-F]+", [*"-+0123456789"]),
    "float": (
        r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9_]*)?)([eE][-+]?[0-9]+)?"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        [*"-+.0123456789"],
    ),
    "merge": ("<<", ["<"]),
}
for _tag, (_form, _first) in _CORE.items():
    for _of in (_Loader, _Dumper):
        _of.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(f"({_form})$"), _first
        )
_Loader.add_constructor(
    "tag:yaml.org,2002:int",
    lambda _, node: int(node.value, 0 if node.value[:2] in ("0o", "0x") else 10),
)

Set: TypeAlias = Mapping[str, Any] | Iterable[str]


class Config(BaseModel):
    """Base of all settings: without unknown keys, with finite numbers, immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    switches: ClassVar[tuple[str, ...]] = ()  # numbers that may be given as true and false

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_numbers(cls, values: Any) -> Any:
        """Refuse true and false where a number is expected; they would count as 1 and 0."""
        for name, value in values.items() if isinstance(values, Mapping) else ():
            if isinstance(value, bool) and name in cls.model_fields.keys() - {*cls.switches}:
                kinds = _kinds(cls.model_fields[name].annotation)
                if kinds & {int, float} and bool not in kinds:
                    raise ValueError(f"{name}: Input should be a number, not true or false")
        return values


C = TypeVar("C", bound=Config)


def read_settings(
    kind: type[C], name: str | Path | C, set_: Set = (), folder: Path | None = None
) -> C:
    """Read settings by name or from a file, and override single values.

    Parameters
    ----------
    name
        Name of a YAML file in `folder`, a path, or settings.
    set_
        See `key_values`. Keys of parts are joined by dots, as in ``training.batch_size``.

    Raises
    ------
    CpunetError
        If the file cannot be read, or a key or value is not allowed.
    """
    if isinstance(name, str | Path):
        source, values = str(name), read_values(name, folder)
    else:
        source, values = "settings", name.model_dump(exclude_unset=True)
    for key, value in key_values(set_).items():
        *parents, last = key.split(".")
        try:
            reduce(getitem, parents, values)[last] = value
        except (LookupError, TypeError) as error:
            raise CpunetError(f"{source}: {key}: no such setting") from error
    return checked(kind, values, source)


def checked(
    kind: type[C], values: Any, source: str, missing: Mapping[str, str] | None = None
) -> C:
    """Validate settings; an error names the first wrong key in one line.

    Parameters
    ----------
    source
        Start of an error message.
    missing
        What to say of keys that are missing.
    """
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise CpunetError(f"{source}: {_fault(error, kind, values, missing or {})}") from error


def flat(values: Any, joint: str = ".", key: str = "") -> Iterator[tuple[str, Any]]:
    """Each value of nested mappings, after the keys that lead to it.

    Examples
    --------
    >>> dict(flat({"bias_V": 4000, "layer": {"mm": 1.0, "ge": {"top": 2}}}))
    {'bias_V': 4000, 'layer.mm': 1.0, 'layer.ge.top': 2}
    """
    if not isinstance(values, Mapping):
        yield key, values
        return
    for name, value in values.items():
        yield from flat(value, joint, f"{key}{joint}{name}" if key else str(name))


def key_values(set_: Set, *, files: bool = False, folder: Path | None = None) -> dict[str, Any]:
    """Values by key, of a mapping or of ``KEY=VALUE`` words with a value in YAML.

    With `files`, words without ``=`` are YAML files, or some in `folder`.  Later words take
    precedence.

    Examples
    --------
    >>> key_values(["bias_V = 4000", "training.betas=[0.5, 0.9]"])
    {'bias_V': 4000, 'training.betas': [0.5, 0.9]}
    """
    if isinstance(set_, Mapping):
        return {k: v.tolist() if hasattr(v, "tolist") else v for k, v in set_.items()}
    values: dict[str, Any] = {}
    for word in map(str, set_):
        key, equals, text = word.partition("=")
        if files and not equals and (folder is not None or Path(word).is_file()):
            values |= read_values(word, folder)
        elif equals and key.strip():
            values[key.strip()] = _parsed(text, reprlib.repr(word))
        else:
            raise CpunetError(f"{reprlib.repr(word)}: expected KEY=VALUE, as in bias_V=4000")
    return values


def names(folder: Path) -> list[str]:
    """Names of the YAML files in a folder."""
    return sorted(file.stem for file in folder.glob("*.yaml"))


def read_text(name: str | Path, folder: Path | None = None) -> str:
    """Text of a file in UTF-8, given by its path or by its name in `folder`."""
    choices = names(folder) if folder else []
    file = folder / f"{name}.yaml" if folder and str(name) in choices else Path(name)
    try:
        content = file.read_bytes()
    except FileNotFoundError as error:
        wrong = f"neither a file nor one of {', '.join(choices)}" if choices else "no such file"
        raise CpunetError(f"{name}: {wrong}") from error
    except OSError as error:
        raise CpunetError(f"{name}: cannot be read ({error.strerror}); check it") from error
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise CpunetError(f"{name}: line {line} is not UTF-8; save it as UTF-8") from error


def read_values(name: str | Path, folder: Path | None = None) -> dict[str, Any]:
    """Read a mapping from a YAML or JSON file, see `read_text`."""
    is_json = Path(name).suffix.lower() == ".json"  # may be indented with tabs
    values = _parsed(read_text(name, folder), str(name), is_json=is_json)
    if not isinstance(values, dict):
        raise CpunetError(f"{name}: holds no settings; write lines such as dt_ns: 16")
    return values


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """Read a mapping from a JSON file; `remedy` says what to do if that fails."""
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise CpunetError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    except ValueError as error:
        raise CpunetError(f"{path}: damaged ({error}); {remedy}") from error
    if not isinstance(content, dict):
        raise CpunetError(f"{path}: damaged (no mapping); {remedy}")
    return content


def plain(value: Any) -> Any:
    """Convert nested values, also of NumPy, to what JSON has; non-finite numbers to None.

    Examples
    --------
    >>> plain({"a": (1, float("nan"))})
    {'a': [1, None]}
    """
    return to_jsonable_python(value, inf_nan_mode="null", fallback=lambda array: array.tolist())


def yaml_text(values: Any) -> str:
    """YAML that `read_values` reads as these values."""
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def _parsed(text: str, source: str, *, is_json: bool = False) -> Any:
    try:
        return json.loads(text) if is_json else yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError) as error:
        raise CpunetError(f"{source}: not YAML ({' '.join(str(error).split())})") from error


def _fault(
    error: ValidationError, kind: type[Config], values: Any, missing: Mapping[str, str]
) -> str:
    faults = error.errors(include_url=False)
    # what is missing may be misspelt
    first = next((fault for fault in faults if fault["type"] == "extra_forbidden"), faults[0])
    # a location also has the members of unions
    keys: list[Any] = []
    for place, part in enumerate(first["loc"]):
        try:
            values = values[part]
        except (LookupError, TypeError):
            if first["type"] != "missing" or place < len(first["loc"]) - 1:
                continue
        keys.append(part)
    key = ".".join(map(str, keys))
    if first["type"] == "missing":
        return f"{key}: {missing.get(key, 'missing; add it')}"
    if first["type"] == "extra_forbidden":
        kinds: set[Any] = {kind}
        for name in filter(lambda name: isinstance(name, str), keys[:-1]):  # no place in a list
            fields = [of.model_fields[name] for of in kinds if name in of.model_fields]
            kinds = set().union(*(_kinds(field.annotation) for field in fields))
            kinds = {of for of in kinds if isinstance(of, type) and issubclass(of, Config)}
        names = [*dict.fromkeys(name for of in kinds for name in of.model_fields)]
        near = difflib.get_close_matches(str(keys[-1]), names, 1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(names)}"
        return f"{key[:60]}: no such setting; {hint}"
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] != "value_error":
        message += f" ({reprlib.repr(first['input'])})"
    return f"{key}: {message}" if key else message


def _kinds(annotation: Any) -> set[Any]:
    """Types that an annotation such as ``Annotated[float, ...] | None`` allows."""
    parts = get_args(annotation)
    if get_origin(annotation) is Annotated:
        parts = parts[:1]
    return set().union(*map(_kinds, parts)) if parts else {annotation}


def require_seed(seed: int) -> int:
    """The seed, if random numbers can begin with it.

    Raises
    ------
    CpunetError
        If it is not from 0 to 2³² - 1.
    """
    if not 0 <= seed < 2**32:
        raise CpunetError(f"`seed`: {seed} is not from 0 to {2**32 - 1}")
    return seed
