"""Data flow one way through the house: no module imports from a later room."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import cpunet

HOUSE = Path(cpunet.__file__).parent
PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))
ROOMS = PROJECT["tool"]["cpunet"]["rooms"]
LAST = ("inspection", "demonstration", "cli")  # behind all rooms


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


def test_no_module_imports_from_a_later_room() -> None:
    found = {path.name for path in HOUSE.iterdir() if (path / "__init__.py").exists()}
    assert found == set(ROOMS)
    wrong = []
    for place, room in enumerate(ROOMS):
        later = tuple(f"cpunet.{name}." for name in (*ROOMS[place + 1 :], *LAST))
        for path in (HOUSE / room).rglob("*.py"):
            names = {n for n in imported(path) if f"{n}.".startswith(later)}
            wrong += [f"{path.relative_to(HOUSE)} imports {name}" for name in sorted(names)]
    assert not wrong
