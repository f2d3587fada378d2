"""Recipes: all settings of a run in a validated YAML file."""

from __future__ import annotations

from pathlib import Path

from cpunet.errors import CpunetError
from cpunet.recipes.schema import Recipe
from cpunet.settings import Set, names, read_settings

_FOLDER = Path(__file__).parent


def list_recipes() -> list[str]:
    """Names of the recipes that come with the package."""
    return names(_FOLDER)


def load_recipe(recipe: str | Path | Recipe, settings: Set = ()) -> Recipe:
    """Read a recipe by name, or from a YAML file, and override single values.

    Parameters
    ----------
    recipe
        Any of `list_recipes`, a path to a YAML file, or a recipe, which is returned.
    settings
        ``"training.batch_size=16"`` and the like; values are YAML. Or a mapping.

    Raises
    ------
    CpunetError
        If no recipe has this name, or a key or value is not allowed, or a recipe that is whole
        already is to be overridden.

    Examples
    --------
    >>> recipe = load_recipe("published", {"training.batch_size": 16})
    >>> recipe.generator.width, recipe.training.batch_size
    (40, 16)
    """
    if not isinstance(recipe, Recipe):
        return read_settings(Recipe, recipe, settings, _FOLDER)
    if settings:
        raise CpunetError(
            "settings override values of a recipe that is given by name; this recipe is whole "
            "already",
            "change it, and leave settings out",
        )
    return recipe
