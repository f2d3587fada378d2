"""Pages of the site that are made from the sources."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

import cpunet

HOOKS = Path(__file__).resolve().parents[1] / "docs" / "hooks"


def hook(name: str, needs: str) -> ModuleType:
    pytest.importorskip(needs)
    spec = importlib.util.spec_from_file_location(f"docs_hook_{name}", HOOKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_option_of_every_command_is_in_the_reference():
    made = hook("commands", "mkdocs")
    index = made.index_page()
    for name, command in made.commands():
        page = made.command_page(name, command)
        assert f"[`{name}`]" in index
        for option in command.params:
            if option.param_type_name == "option" and not option.hidden:
                assert f"`{option.opts[0]}`" in page


def test_every_public_name_is_in_the_reference():
    made = hook("api", "mkdocs")
    for name in set(cpunet.__all__) - {"__version__"}:
        assert f"::: cpunet.{name}\n" in made.FRONT
    pages = "".join(made.room_page(folder) for folder in made.rooms())
    assert "::: cpunet.pulses.parameters\n" in pages
    assert "::: cpunet.cli" not in pages


def test_formulas_of_docstrings_become_mathml():
    made = hook("formulas", "latex2mathml")
    text = made.as_markdown(
        "A :math:`x^2` and\n\n.. math:: y\n    = z\n\n"
        ".. math::\n\n    a = b\n    + c\n\nThen `f` of :func:`cpunet.f`."
    )
    assert "A $x^2$ and" in text
    assert "$$\ny = z\n$$" in text
    assert "$$\na = b + c\n$$" in text
    assert text.rstrip().endswith("Then `f` of `cpunet.f`.")
    html = made.on_page_content('<span class="arithmatex">\\(a &lt; b\\)</span>')
    assert html.startswith("<math")
    assert "&lt;" in html or "&#x0003C;" in html
