"""Pages of the site that are made from the sources."""

from __future__ import annotations

import importlib.util
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import cpunet

DOCS = Path(__file__).resolve().parents[1] / "docs"
HOOKS = DOCS / "hooks"
NOTEBOOKS = sorted(DOCS.rglob("*.ipynb"))
BASH = "%%bash\n"


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
    index, usual = made.index_page(), made.app.default_parameter
    for name, command in made.commands():
        page = made.command_page(name, command)
        assert f"[`{name}`]" in index
        for option in command.assemble_argument_collection(default_parameter=usual):
            if option.show and option.field_info.kind is inspect.Parameter.KEYWORD_ONLY:
                assert f"`{option.names[0]}`" in page


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


def cells(notebook: Path) -> list[dict]:
    return [c for c in json.loads(notebook.read_text())["cells"] if c["cell_type"] == "code"]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_pages_with_what_their_cells_showed(notebook):
    page = hook("notebooks", "mkdocs").page(notebook)
    shown = [output for cell in cells(notebook) for output in cell["outputs"]]
    assert all(cell["outputs"] for cell in cells(notebook))
    for output in shown:
        assert output["output_type"] != "error"
        assert output.get("name") != "stderr"
        for line in output.get("text", ()):
            assert line.rstrip() in page
        for line in output.get("data", {}).get("text/html", "").splitlines():
            assert line in page
        for kind in {"image/png"} & output.get("data", {}).keys() - {"text/html"}:
            assert output["data"][kind] in page
    assert notebook.name in page


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_from_top_to_bottom(notebook, tmp_path, monkeypatch):
    """Every cell in turn, with fewer events and a fit that ends at once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    names: dict[str, object] = {}
    for cell in cells(notebook):
        source = "".join(cell["source"])
        source = source.replace("FEP=2500,SEP=1000,DEP=1000", "FEP=500,SEP=120,DEP=120")
        source = source.replace(
            '"run", progress', 'settings={"training.steps": 1}, out="run", progress'
        )
        if source.startswith(BASH):
            command = ["bash", "-c", source.removeprefix(BASH)]
            subprocess.run(command, env=os.environ | {"PATH": path}, check=True)
        else:
            exec(compile(source, notebook.name, "exec"), names)
    assert (tmp_path / "report" / "report.html").exists()
