"""Arguments of the calls: input files with their reading options, and recipes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from cpunet.errors import CpunetError
from cpunet.jobs.common.inputs import InputFile
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe

File: TypeAlias = str | Path | InputFile


def as_input(file: File, name: str) -> InputFile:
    """Return a file of pulses with its reading options.

    Raises
    ------
    CpunetError
        If it is neither a path nor an `InputFile`.
    """
    if isinstance(file, InputFile):
        return replace(file, path=Path(file.path))  # users may give text
    if isinstance(file, str | Path):
        return InputFile(Path(file))
    raise CpunetError(
        f"{name} is of type {type(file).__name__}; give a path, or cpunet.InputFile(path, …); "
        "arrays are written with cpunet.pulses.writing.write_pulses first"
    )


def as_recipe(recipe: str | Path | Recipe, settings: Mapping[str, Any] | None) -> Recipe:
    """Return a recipe, read by name or from a file with single values overridden, or as given.

    Examples
    --------
    >>> as_recipe("paper", {"training.batch_size": 16}).training.batch_size
    16

    Raises
    ------
    CpunetError
        If there is no such recipe or value.
    """
    if not isinstance(recipe, Recipe):
        return load_recipe(recipe, settings or {})
    if settings:
        raise CpunetError(
            "settings override values of a recipe that is given by name; this one is whole "
            "already, so change it and leave settings out"
        )
    return recipe
