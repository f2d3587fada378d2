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
from cpunet.yaml_files import parsed


def recipe_names() -> list[str]:
    """Names of the recipes that come with the package."""
    folder = files("cpunet.recipes")
    return sorted(
        f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml")
    )


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
        text = (files("cpunet.recipes") / f"{name}.yaml").read_text()
    elif Path(name).is_file():
        try:
            text = Path(name).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise CpunetError(f"recipe {name}: cannot be read as text ({error})") from error
    else:
        raise CpunetError(
            f"recipe {name!r}: neither a file nor one of {', '.join(recipe_names())}"
        )
    try:
        settings = parsed(text)
    except yaml.YAMLError as error:
        raise CpunetError(
            f"recipe {name}: not YAML ({' '.join(str(error).split())})"
        ) from error
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
    """Where in the YAML an error is: without the kind that pydantic puts after a choice."""
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
        raise CpunetError(f"--set {override}: expected KEY=VALUE, as in training.batch_size=16")
    *parents, last = key.split(".")
    node = settings
    for parent in parents:
        node = node.get(parent) if isinstance(node, dict) else None
    if not isinstance(node, dict) or last not in node:
        raise CpunetError(f"--set {override}: the recipe has no {key}")
    try:
        node[last] = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise CpunetError(f"--set {override}: {value!r} is not YAML") from error
