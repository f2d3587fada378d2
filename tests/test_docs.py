"""What README and docs print runs as it is printed, and what the site makes of the sources."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType

import jsonschema
import numpy as np
import pytest
import yaml

import cpunet
from cpunet.cli import application, with_options
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import list_recipes, load_recipe
from cpunet.training.train import train
from cpunet.translation.translator import RejectionWarning
from synthetic import KEV, phased_edges, write_pulses, write_sides

app = application()
ROOT = Path(__file__).resolve().parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# Seconds of simulation or training each, or files that it would take: their imports are tried
# only.
TOO_LONG = {"simulation.md", "legend.md", "python.md"}
# a fit that looks for no other valley, whatever it has found
SHORT = ("start_factors=[1]",)
MADE_BY_THE_SITE = ("reference/", "../reference/")
DOCS = ROOT / "docs"
HOOKS = DOCS / "hooks"
NOTEBOOKS = sorted(DOCS.rglob("*.ipynb"))
BASH = "%%bash\n"
PAGE = DOCS / "troubleshooting.md"
QUOTED = re.findall(r"^\| `(.+?)` \|", PAGE.read_text(), re.MULTILINE)


def blocks(*languages: str) -> list:
    found = []
    for page in PAGES:
        marks = [pytest.mark.thorough] if page.name in TOO_LONG else []
        for i, (language, code) in enumerate(BLOCK.findall(page.read_text())):
            if language in languages:
                name = f"{page.relative_to(ROOT)}-{i}"
                found.append(pytest.param(page, code, id=name, marks=marks))
    return found


def commands(code: str) -> list[list[str]]:
    """The words of each line of a console, without comments; brackets hold what may be left."""
    lines = code.replace("\\\n", " ").replace("[--", "--").replace("]\n", "\n").splitlines()
    words = (shlex.split(line, comments=True) for line in lines if "…" not in line)
    return [line for line in words if line]


def require_parsed(words: list[str]) -> None:
    """Have the command line's own parser read the words; nothing is run.

    What is set of a recipe must be one of its settings.
    """
    _, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    given = bound.arguments
    if given.get("recipe") in list_recipes():
        load_recipe(given["recipe"], given.get("settings") or ())


def option_names(words: list[str]) -> set[str]:
    """Options of a command; none of a group of commands."""
    command = app
    for word in words:
        if word not in [*command] or word.startswith("-"):
            break
        command = command[word]
    if command.default_command is None:
        return set()
    found = command.assemble_argument_collection(default_parameter=app.default_parameter)
    return {name for argument in found for name in argument.names}


@pytest.mark.parametrize(("page", "code"), blocks("", "sh", "console"))
def test_the_commands(page, code):
    for words in commands(code):
        if "cpunet" in words:
            require_parsed(words[words.index("cpunet") + 1 :])
        for word in words:
            if word.startswith(("benchmarks/", "workflow/")):
                assert (ROOT / word).exists(), f"{page.name}: {word}"


@pytest.mark.thorough
def test_the_commands_within_sentences():
    """What stands in a sentence may lack arguments, but its command and options are there."""
    for page in PAGES:
        for inline in re.findall(r"(?<!`)`cpunet ([^`]+)`(?!`)", page.read_text()):
            words = inline.split()
            first = words[0].strip("[]")
            assert first in [*app] or not first.isalpha() or first.isupper(), inline
            given = {word.strip("[]").partition("=")[0] for word in words}
            options = {word for word in given if word[:2] == "--"}
            assert options <= option_names(words) | {"--help", "--version", "--debug"}, inline


@pytest.mark.parametrize(("page", "code"), blocks("yaml"))
def test_the_yaml(page, code):
    content = yaml.safe_load(code)
    if "periods" in content:
        schema = yaml.safe_load((ROOT / "workflow" / "config" / "schema.yaml").read_text())
        jsonschema.validate(content, schema)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_links(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        name, _, heading = target.partition("#")
        if "://" in target or name.startswith(MADE_BY_THE_SITE):
            continue
        file = (page.parent / name).resolve() if name else page
        if not heading and file.with_suffix(".ipynb").exists():
            continue  # the site makes a page of a notebook
        assert file.exists(), f"{page.name}: {target}"
        if heading:
            titles = re.findall(r"^#+ (.+)$", file.read_text(), re.MULTILINE)
            assert heading in map(slugify, titles), f"{page.name}: {target}"


def slugify(title: str) -> str:
    """The anchor of a heading."""
    words = re.sub(r"[^\w\s-]", "", title.lower()).strip()
    return re.sub(r"[-\s]+", "-", words)


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """The files that the pages speak of, sim.lh5 as `cpunet simulate` may write it."""
    folder, kev = tmp_path_factory.mktemp("docs"), np.full(260, KEV[0])
    kev[3] = 1.0  # the rest was lost in the lithium layer
    write_sides(folder, kev, dead=7)  # of which nothing was collected
    edges = phased_edges(4, np.random.default_rng(2), 550, 3000)
    fine = Pulses.of(edges, dt_ns=1, energy_kev=np.full(4, KEV[0]))
    write_pulses(folder / "fine.lh5", fine)
    recipe = load_recipe("fast", [f"training.{value}" for value in SHORT])
    sides = PulseFile(folder / "sim.lh5"), PulseFile(folder / "raw.lh5")
    train(*sides, folder / "run", recipe=recipe, device="cpu")
    for seed in ("seed_000", "seed_001"):
        shutil.copytree(folder / "run", folder / "ens" / seed)
    return folder


@pytest.mark.parametrize(("page", "code"), blocks("python"))
def test_the_python(page, code, home, monkeypatch):
    monkeypatch.chdir(home)
    if page.name in TOO_LONG:
        compile(code, page.name, "exec")
        code = "\n".join(line for line in code.splitlines() if re.match("from|import", line))
    names: dict[str, object] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RejectionWarning)
        exec(compile(code, page.name, "exec"), names)
    if "measured_like" in names:
        lost = np.isnan(names["measured_like"]).any(axis=1)
        assert lost[7]  # and the one of 1 keV, if its noise is too high
        assert set(np.flatnonzero(lost)) <= {3, 7}


@pytest.mark.slow
def test_the_first_tutorial_from_end_to_end(tmp_path):
    """Every command of it in turn, with fewer events and a fit that ends at once."""
    page = ROOT / "docs" / "tutorials" / "first-ren.md"
    texts = [code for language, code in BLOCK.findall(page.read_text()) if language == ""]
    lines = [words for code in texts for words in commands(code) if words[0] == "cpunet"]
    assert lines[0][1] == "stand"
    for words in lines:
        if "--events" in words:
            words[words.index("--events") + 1] = "FEP=500,SEP=120,DEP=120"
        if words[1] == "train":
            words += [w for value in SHORT for w in ("--set", f"training.{value}")]
            words += ["--set", "scores.bootstraps=10"]
        program = [sys.executable, "-m", "cpunet", *words[1:]]
        done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True)
        # so short a fit may be bad, and is written
        bad = words[1] == "train" and done.returncode == 1
        assert bad or done.returncode == 0, (words, done.stderr)
    for made in ("check.png", "run/run.json", "translated.lh5", "report/report.html"):
        assert (tmp_path / made).exists()


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


def test_pictures_of_the_design_are_those_of_the_code(tmp_path, monkeypatch):
    made = hook("diagrams", "numpy")
    monkeypatch.setattr(made, "PICTURES", tmp_path)
    made.rooms()
    for name in made.WAYS:
        made.way(name)
    drawn = {path.name: path.read_text("utf-8") for path in tmp_path.iterdir()}
    assert len(drawn) == 4
    for name, picture in drawn.items():
        stored = (DOCS / "pictures" / name).read_text("utf-8")
        assert stored == picture, f"{name}: run docs/hooks/diagrams.py"


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
        ".. math::\n\n    a = b\n    + c\n\nAs in::\n\n    f(x)\n\n"
        "Then `f` of :func:`cpunet.f`."
    )
    assert "A $x^2$ and" in text
    assert "$$\ny = z\n$$" in text
    assert "$$\na = b + c\n$$" in text
    assert "As in:\n\n    f(x)" in text
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
        short = 'settings={"training.steps": 1}, out="run", progress'
        source = source.replace('"run", progress', short)
        if source.startswith(BASH):
            command = ["bash", "-c", source.removeprefix(BASH)]
            subprocess.run(command, env=os.environ | {"PATH": path}, check=True)
        else:
            exec(compile(source, notebook.name, "exec"), names)
    assert (tmp_path / "report" / "report.html").exists()


def text_of(node: ast.AST) -> str:
    """A text; one with values in it as its fixed parts, in order; an error with its remedy."""
    if isinstance(node, ast.JoinedStr):
        return "…".join(filter(None, map(text_of, node.values)))
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "CpunetError":
        return "; ".join(map(text_of, node.args))
    value = getattr(node, "value", None)
    return value if isinstance(value, str) else ""


@pytest.fixture(scope="module")
def messages() -> str:
    """All texts of the package, as the command line shows them."""
    paths = sorted((ROOT / "src").rglob("*.py"))
    nodes = (node for path in paths for node in ast.walk(ast.parse(path.read_text())))
    return with_options("\n".join(map(text_of, nodes)))


@pytest.mark.parametrize("quoted", QUOTED)
def test_a_quoted_message_is_one_of_the_program(quoted, messages):
    for part in quoted.removeprefix("warning: ").split("…"):  # its level
        assert part.strip("… ") in messages, f"no message has {part!r}; correct {PAGE.name}"
