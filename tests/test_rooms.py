"""Data flow one way through the house: no module imports from a later room."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import cpunet

HOUSE = Path(cpunet.__file__).parent
PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))
ORDER = PROJECT["tool"]["cpunet"]


def imported(path: Path) -> Iterator[str]:
    """Modules of the package that a module imports, wherever in it; of a run, when loaded.

    `Run.translate` and such import from later rooms when they are called: the only exception.
    """
    tree = ast.parse(path.read_text("utf-8"))
    for node in tree.body if path == HOUSE / "training" / "run.py" else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)


@pytest.mark.parametrize(
    ("house", "package", "rooms"),
    [
        (HOUSE, "cpunet.", ORDER["rooms"]),
        (HOUSE / "jobs", "cpunet.jobs.", ORDER["jobs"]),
    ],
)
def test_no_module_imports_from_a_later_room(
    house: Path, package: str, rooms: list[str]
) -> None:
    found = {path.name for path in house.iterdir() if (path / "__init__.py").exists()}
    assert found == set(rooms)
    wrong = []
    for place, room in enumerate(rooms):
        later = tuple(f"{package}{name}" for name in rooms[place + 1 :])
        for path in (house / room).rglob("*.py"):
            names = {
                n for n in imported(path) if f"{n}.".startswith(tuple(f"{r}." for r in later))
            }
            wrong += [f"{path.relative_to(HOUSE)} imports {name}" for name in sorted(names)]
    assert not wrong
