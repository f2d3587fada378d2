"""``--force`` replaces no input, whatever the command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cyclopts import App

from cpunet.cli import app

GAMMAS = "--detector icpc --events FEP=1"
TRAINING = "--sim D/sim.lh5 --data D/data.lh5"
# Words of each command, and names for --out that are, hold or lie in one of its inputs.
COMMANDS = {
    "demo": [],  # reads no file
    "simulate": [
        ("--detector icpc --hits D/hits.lh5", "D/hits.lh5"),
        ("--detector icpc --hits D/link.lh5", "D/hits.lh5"),
        ("--detector D/my.yaml --events FEP=1", "D/my.yaml"),
    ],
    "stand": [
        ("--preset D/my.yaml", "D"),
        ("--preset ornl --detector D/my.yaml", "D"),
        ("--preset ornl --shift bias_V=20 --shift D/my.yaml", "D"),
    ],
    "check": [
        (TRAINING, "D/data.lh5"),
        (f"{TRAINING} --data-energy D/hits.lh5:ch1/hit/energy", "D/hits.lh5"),
    ],
    "train": [
        (TRAINING, "D"),
        (TRAINING, "."),
        (f"{TRAINING} --recipe D/my.yaml", "D"),
        ("--sim sim.lh5 --data data.lh5 --data-energy D/hits.lh5:ch1/hit/energy", "D"),
        ("--sim sim.lh5 --data data.lh5 --init RUN", "RUN"),
    ],
    "calibrate": [
        (TRAINING, "D"),
        (f"{TRAINING} --recipe D/my.yaml", "D"),
    ],
    "translate": [
        ("RUN D/sim.lh5", "D/sim.lh5"),
        ("RUN D/link.lh5", "D/hits.lh5"),
        ("RUN D/*.lh5", "D"),
        ("RUN sim.lh5", "RUN/weights.safetensors"),
        ("RUN D/sim.lh5 --energy D/hits.lh5:energy", "D/hits.lh5"),
    ],
    "validate": [
        (f"RUN {TRAINING}", "D"),
        (f"RUN {TRAINING}", "RUN"),
        ("RUN --sim sim.lh5 --data data.lh5 --truth D/truth.npz", "D"),
    ],
    "info": [
        ("D/sim.lh5", "D/sim.lh5"),
        ("sim.lh5 --energy D/hits.lh5:energy", "D/hits.lh5"),
    ],
    "compare": [("REPORT/metrics.json", "REPORT/metrics.json"), ("REPORT", "REPORT/c.html")],
    "response": [("RUN", "RUN"), ("RUN --truth D", "D"), ("RUN", ".")],
    "export onnx": [
        ("RUN", "RUN/weights.safetensors"),
        ("RUN --report REPORT", "REPORT/ren.onnx"),
    ],
    "export legend": [("RUN", "RUN"), ("RUN --report REPORT", "REPORT")],
    "library make": [
        ("--detector D/my.yaml", "D/my.yaml"),
        ("--detector icpc --settings D/my.yaml", "D/my.yaml"),
    ],
    "library translate": [("RUN D/hits.lh5", "D/hits.lh5"), ("RUN D/hits.lh5", "RUN/l.lh5")],
    "import": [("--ren D/fep_REN.pt", "D")],
}
CASES = [
    pytest.param(name, words, out, id=f"{name} {words} {out}")
    for name, cases in COMMANDS.items()
    for words, out in cases
]


def writing_commands(below: App = app, name: str = "") -> set[str]:
    """Names of all commands that have ``--force``."""
    if below.default_command is not None:
        options = below.assemble_argument_collection(default_parameter=app.default_parameter)
        return {name} if any("--force" in option.names for option in options) else set()
    words = [word for word in below if word[0] != "-"]
    return {
        found
        for word in words
        for found in writing_commands(below[word], f"{name} {word}".strip())
    }


def test_every_command_that_writes_is_here():
    assert writing_commands() == set(COMMANDS)


@pytest.fixture
def home(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's folder: files to read, a run, a report, and a thesis everywhere."""
    monkeypatch.chdir(tmp_path)
    run.rename(tmp_path / "RUN")
    names = "sim.lh5 data.lh5 hits.lh5 truth.npz my.yaml my.pickle fep_REN.pt thesis.tex"
    for folder in ("D", "REPORT", "demo/run", "demo/stand"):
        Path(folder).mkdir(parents=True)
        for name in names.split():
            Path(folder, name).write_text(f"the user's {name}")
    # all that would make a folder one to be replaced
    for name in ("run.json", "metrics.json", "stand.json"):
        Path("D", name).write_text("{}")
    for name in ("sim.lh5", "data.lh5"):
        Path(name).touch()
    Path("D/response.json").write_text("{}")
    Path("REPORT/metrics.json").write_text(json.dumps({"peaks": {}}))
    Path("REPORT/report.html").touch()
    Path("D/link.lh5").symlink_to("hits.lh5")
    return tmp_path


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("name", "words", "out"), CASES)
def test_no_input_is_replaced(command, home, name, words, out):
    before = contents(home)
    outcome = command(*name.split(), *words.split(), "--out", out, "--force")
    assert outcome.code == 2
    assert outcome.err.count("\n") == 1
    assert "the input" in outcome.err
    assert contents(home) == before
