"""What README and docs print runs as it is printed."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml

import cpunet
from cpunet.cli import app
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.writing import write_pulses
from cpunet.recipes import list_recipes, load_recipe
from cpunet.training.train import train
from cpunet.translation.translator import RejectionWarning
from synthetic import decay, phased_edges

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# Seconds of simulation or training each, or files that it would take: their imports are tried
# only.
TOO_LONG = {"simulation.md", "legend.md", "python.md"}
MADE_BY_THE_SITE = ("reference/", "../reference/")
KEV = 2614.511


def blocks(*languages: str) -> list:
    return [
        pytest.param(
            page,
            code,
            id=f"{page.relative_to(ROOT)}-{i}",
            marks=[pytest.mark.thorough] if page.name in TOO_LONG else [],
        )
        for page in PAGES
        for i, (language, code) in enumerate(BLOCK.findall(page.read_text()))
        if language in languages
    ]


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
    """Files that a page links to or shows are there, and so are the headings."""
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


def test_the_files_to_copy_are_there():
    for path in re.findall(
        r"`((?:src|tests|docs)/[\w./-]+)`", (ROOT / "CONTRIBUTING.md").read_text()
    ):
        assert (ROOT / path).exists(), path
    for path in re.findall(r"`((?:\w+/)+\w+\.py)`", (ROOT / "CONTRIBUTING.md").read_text()):
        assert (ROOT / path).exists() or (ROOT / "src" / "cpunet" / path).exists(), path


def slugify(title: str) -> str:
    """The anchor of a heading."""
    words = re.sub(r"[^\w\s-]", "", title.lower()).strip()
    return re.sub(r"[-\s]+", "-", words)


SHORT = ("steps=1", "components=4", "squares=2", "start_factors=[1]", "ringing_mhz=[]")
"""A fit that ends at once, whatever it has found."""


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """The files that the pages speak of, sim.lh5 as `cpunet simulate` may write it."""
    folder, rng = tmp_path_factory.mktemp("docs"), np.random.default_rng(1)
    sim = phased_edges(260, rng, 550, 1200)
    sim[7] = 0  # of which nothing was collected
    kev = np.full(len(sim), KEV)
    kev[3] = 1.0  # the rest was lost in the lithium layer
    write_pulses(folder / "sim.lh5", Pulses.of(sim, dt_ns=16, energy_kev=kev))
    decayed = phased_edges(260, rng, 550, 1200) * decay(550, 4000, 1200)
    raw = np.round(1000 + 10 * KEV * decayed + rng.normal(0, 20, decayed.shape))
    pulses = Pulses.of(raw, dt_ns=16, energy_kev=np.full(len(raw), KEV))
    write_pulses(folder / "raw.lh5", pulses, table="geds/raw", waveform_units="ADC")
    fine = Pulses.of(phased_edges(4, rng, 550, 3000), dt_ns=1, energy_kev=np.full(4, KEV))
    write_pulses(folder / "fine.lh5", fine)
    recipe = load_recipe("fast", [f"training.{value}" for value in (*SHORT, "noise_sets=1")])
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
    lines = [
        words
        for language, code in BLOCK.findall(page.read_text())
        if language == ""
        for words in commands(code)
        if words[0] == "cpunet"
    ]
    assert lines[0][1] == "stand"
    for words in lines:
        if "--events" in words:
            words[words.index("--events") + 1] = "FEP=500,SEP=120,DEP=120"
        if words[1] == "train":
            words += [w for value in SHORT for w in ("--set", f"training.{value}")]
            words += ["--set", "scores.bootstraps=10"]
        code = "from cpunet.cli import main; main()"
        done = subprocess.run(
            [sys.executable, "-c", code, *words[1:]],
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, (words, done.stderr)
    for made in ("check.png", "run/run.json", "translated.lh5", "report/report.html"):
        assert (tmp_path / made).exists()


def test_the_distribution_is_not_the_authors():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == "cpunet-hpge"
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == cpunet.__version__
