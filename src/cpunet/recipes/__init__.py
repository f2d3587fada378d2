"""Recipes: all settings of a run in one validated YAML file."""

from __future__ import annotations

from pathlib import Path

from cpunet.recipes.schema import Recipe
from cpunet.settings import Set, names, read_settings

_FOLDER = Path(__file__).parent


def recipe_names() -> list[str]:
    """Names of the recipes that come with the package."""
    return names(_FOLDER)


def load_recipe(name: str | Path, overrides: Set = ()) -> Recipe:
    """Read a recipe by name, or from a YAML file, and override single values.

    Parameters
    ----------
    name
        One of `recipe_names`, or a path to a YAML file.
    overrides
        ``"training.batch_size=16"`` and the like; values are YAML. Or a mapping.

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
    return read_settings(Recipe, name, overrides, _FOLDER)
