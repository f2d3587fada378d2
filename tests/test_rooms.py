"""Data flow one way through the house, and what is installed is what it says."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

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


def test_a_package_installed_over_this_one_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(cpunet, "__file__", str(tmp_path / "cpunet" / "__init__.py"))
    (tmp_path / "cpunet-1.0.0.dist-info").mkdir()
    cpunet.other_package.cache_clear()
    told = (
        "the package cpunet 1.0.0 is installed over cpunet-hpge, of the same import name; "
        "pip uninstall cpunet cpunet-hpge, then install the one you want"
    )
    try:
        assert cpunet.other_package() == told
        with pytest.warns(UserWarning, match="installed over cpunet-hpge"):
            assert cpunet.Pulses
    finally:
        cpunet.other_package.cache_clear()


def test_the_lock_holds_what_the_constraints_say():
    """Every dependency, in the version that is known to work, with the digest of its file."""
    root = Path(__file__).resolve().parents[1]
    lines = (root / "requirements.lock").read_text().splitlines()
    locked = {}
    for line in lines:
        if not line.startswith("#"):
            match = re.fullmatch(r"([a-z0-9._-]+)==(\S+) --hash=sha256:[0-9a-f]{64}", line)
            assert match, line
            locked[re.sub(r"[._-]+", "-", match[1])] = match[2]
    constraints = {}
    for line in (root / "constraints.txt").read_text().splitlines():
        name, pinned, version = line.partition("==")
        if pinned:
            constraints[re.sub(r"[._-]+", "-", name.lower())] = version
    for name, version in locked.items():
        assert constraints.get(name, version).partition("+")[0] == version.partition("+")[0]
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((root / "CITATION.cff").read_text())
    assert (project["name"], citation["version"]) == ("cpunet-hpge", cpunet.__version__)
    for dependency in project["dependencies"]:
        assert re.split(r"[<>=]", dependency)[0].lower() in locked
