"""The settings of a recipe that tuning varies, and recipes with values for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cpunet.errors import CpunetError
from cpunet.recipes import recipe_from
from cpunet.recipes.schema import Recipe, SearchConfig

# Pulses and their comparison must be the same for all trials, so only these may be tuned.
ROOMS = ("generator", "discriminator", "training")


def search_space(recipe: Recipe) -> dict[str, SearchConfig]:
    """The search space of a recipe, after checking its keys and values.

    Raises
    ------
    CpunetError
        If there is none, or a key or value is not allowed; the message names the key.
    """
    if not recipe.search:
        raise CpunetError(
            f"recipe {recipe.name}: has no search space; add one, as "
            "search: {training.ridge: {low: 0.01, high: 0.2, log: true}}"
        )
    for key, config in recipe.search.items():
        if key.split(".")[0] not in ROOMS:
            raise CpunetError(
                f"recipe {recipe.name}: search.{key}: only settings of {', '.join(ROOMS)} "
                "can be tuned"
            )
        value_of(recipe, key)
        for value in config.choices or (config.low, config.high):
            with_values(recipe, {key: value})
    return dict(recipe.search)


def value_of(recipe: Recipe, key: str) -> Any:
    """The value of a setting.

    Raises
    ------
    CpunetError
        If the recipe has none of that name.
    """
    node: Any = recipe.model_dump(mode="json")
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            raise CpunetError(f"recipe {recipe.name}: search.{key}: there is no such setting")
        node = node[part]
    return node


def with_values(recipe: Recipe, values: Mapping[str, Any]) -> Recipe:
    """A recipe with other values, and no search space.

    Raises
    ------
    CpunetError
        If a value is not allowed.
    """
    settings = recipe.model_dump(mode="json") | {"search": None}
    for key, value in values.items():
        *parents, last = key.split(".")
        node = settings
        for parent in parents:
            node = node[parent]
        node[last] = value
    told = ", ".join(f"{key} = {value}" for key, value in values.items())
    return recipe_from(settings, source=f"recipe {recipe.name}, search, {told}")


def is_whole(recipe: Recipe, key: str, config: SearchConfig) -> bool:
    """Whether a range is one of integers."""
    numbers = (value_of(recipe, key), config.low, config.high)
    return all(isinstance(n, int) and not isinstance(n, bool) for n in numbers)


def holds(config: SearchConfig, value: Any) -> bool:
    """Whether a search space contains a value of a setting."""
    if config.choices is not None:
        return value in config.choices
    assert config.low is not None
    assert config.high is not None
    return isinstance(value, int | float) and config.low <= value <= config.high
