"""Recipes: all settings of a run in one validated YAML file."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from cpunet.errors import CpunetError
from cpunet.recipes.schema import Recipe
from cpunet.regular_files import read_text
from cpunet.yaml_files import MAX_BYTES, parsed, shown, yaml_names

_FOLDER = files("cpunet.recipes")


def recipe_names() -> list[str]:
    """Names of the recipes that come with the package."""
    return yaml_names(_FOLDER)


def load_recipe(name: str, overrides: Iterable[str] = ()) -> Recipe:
    """Read a recipe by name, or from a YAML file, and override single values.

    Parameters
    ----------
    name
        One of `recipe_names`, or a path to a YAML file.
    overrides
        ``"training.batch_size=16"`` and the like; values are YAML.

    Raises
    ------
    CpunetError
        If there is no such recipe, or a key or value is not allowed.

    Examples
    --------
    >>> recipe = load_recipe("paper", ["training.batch_size=16"])
    >>> recipe.generator.width, recipe.training.batch_size
    (40, 16)
    """
    if name in recipe_names():
        text = (_FOLDER / f"{name}.yaml").read_text("utf-8")
    elif Path(name).exists():
        try:
            text = read_text(name, MAX_BYTES)
        except OSError as error:
            raise CpunetError(f"recipe {name}: cannot be read as text ({error})") from error
    else:
        raise CpunetError(
            f"recipe {name!r}: neither a file nor one of {', '.join(recipe_names())}"
        )
    try:
        settings = parsed(text)
    except yaml.YAMLError as error:
        said = " ".join(str(error).split())
        raise CpunetError(f"recipe {name}: not YAML ({said[:200]})") from error
    for override in overrides:
        _override(settings, override)
    return recipe_from(settings, source=f"recipe {name}")


def recipe_from(settings: Any, source: str) -> Recipe:
    """Validate settings; errors name the first wrong key in one line."""
    try:
        return Recipe.model_validate(settings)
    except ValidationError as error:
        first, count = error.errors()[0], error.error_count()
        key = ".".join(str(part) for part in _keys(first["loc"])) or "the whole"
        more = f" (and {count - 1} more)" if count > 1 else ""
        raise CpunetError(f"{source}: {key}: {first['msg']}{more}") from error


def _keys(location: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """Location of an error in the YAML, without the kind that pydantic adds after a choice."""
    kinds = {
        "generator": ("punet", "response", "hybrid"),
        "discriminator": ("gru", "conv"),
        "training": ("cyclegan", "matching"),
    }
    if len(location) > 1 and location[1] in kinds.get(str(location[0]), ()):
        return location[:1] + location[2:]
    return location


def _override(settings: Any, override: str) -> None:
    key, equals, value = override.partition("=")
    if not equals:
        raise CpunetError(
            f"--set {shown(override)}: expected KEY=VALUE, as in training.batch_size=16"
        )
    *parents, last = key.split(".")
    node = settings
    for parent in parents:
        node = node.get(parent) if isinstance(node, dict) else None
    if not isinstance(node, dict) or last not in node:
        raise CpunetError(f"--set {shown(override)}: the recipe has no {shown(key)[1:-1]}")
    try:
        node[last] = parsed(value)
    except yaml.YAMLError as error:
        raise CpunetError(f"--set {shown(override)}: {shown(value)} is not YAML") from error
