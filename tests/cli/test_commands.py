"""Commands: help, what they load, print and write, and what force does not replace."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from cyclopts import App

from compiled import OWN
from cpunet.cli import COMMANDS, application
from cpunet.networks.positional_unet import PositionalUNet
from synthetic import in_a_process, rows_of

app = application()


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_has_examples(command, name):
    outcome = command(*name.split(), "--help")
    assert outcome.code == 0
    usage, _, examples = outcome.out.partition("Examples:\n")
    assert f"Usage: cpunet {name}" in usage
    assert all(line.startswith(f"  cpunet {name} ") for line in examples.splitlines())
    assert examples


def test_words_that_are_missing_or_unknown_are_named(command):
    said = command("train", "--sim", "sim.lh5").err
    assert said == "error: --data is missing; see cpunet train --help\n"
    assert command("trai").err.startswith('error: Unknown command "trai"')


@pytest.mark.parametrize("line", [line for lines in OWN for line in lines.split("; ")])
def test_commands_that_compile_what_tests_share_exist(line):
    app.parse_args(line.split(), exit_on_error=False, print_error=False)


@pytest.mark.parametrize(
    ("commands", "heavy"),
    [
        (["--help"], "torch lh5 lgdo dspeed matplotlib scipy numba numpy"),
        (
            ["train --help", "info DATA"],
            "torch numba scipy lh5 lgdo dspeed pandas matplotlib hist",
        ),
    ],
)
def test_help_and_plain_files_load_neither_torch_nor_compiled_loops(stand, commands, heavy):
    """A look at a file waits for nothing that networks, compressed traces or figures need."""
    loaded = f"sys.exit(', '.join(sorted({{*{heavy.split()}}} & sys.modules.keys())) or 0)"
    words = [command.replace("DATA", str(stand.data)) for command in commands]
    done = in_a_process(*words, after=loaded)
    assert (done.returncode, done.stderr) == (0, "")
    n, length = stand.data_waveforms.shape
    assert len(words) == 1 or f"{n} of {length} samples, every 16 ns" in done.stdout


def listing(folder: Path) -> list[str]:
    """Every name in a folder, hidden ones too."""
    return sorted(path.name for path in folder.iterdir())


def test_the_run_folder(trained, stand):
    assert listing(trained.parent) == ["run"]
    made = ".cpunet.json losses.jsonl recipe.yaml run.json weights.safetensors"
    assert listing(trained) == made.split()
    info = json.loads((trained / "run.json").read_text())
    assert (info["recipe"], info["peak"], info["seed"]) == ("published", "FEP", 3)
    assert info["dt_ns"] == 16
    assert info["seconds"] > 0
    for side, kev in (("sim", stand.sim_kev), ("data", stand.data_kev)):
        told = info[side]
        assert told["file"] == str(getattr(stand, side))
        assert told["read"] == len(kev)
        # every pulse is used or has a reason
        assert told["used"] + sum(told["rejections"].values()) == len(kev)
        on_peak = int((abs(kev - 2614.511) <= 5).sum())
        assert told["rejections"]["energy_outside_selection"] == len(kev) - on_peak
        assert told["used"] >= 0.8 * on_peak
    recipe = yaml.safe_load((trained / "recipe.yaml").read_text())
    assert recipe["training"]["iterations"] == 4
    lines = (trained / "losses.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    assert [record["iteration"] for record in records] == [0, 1, 2, 3]


def test_raw_simulations_score_what_is_known_of_them(
    command, trained, stand, tmp_path, monkeypatch, undrawn
):
    """A raw pulse does not decay; the stand's measured ones do, with 55 µs."""
    # translations of which all parameters can be determined
    monkeypatch.setattr(PositionalUNet, "forward", lambda _, pulses, **_options: pulses)
    out = tmp_path / "report"
    words = ("validate", trained, *stand.inputs, "--truth", stand.truth, "--out", out)
    outcome = command(*words)
    assert outcome.code == 0
    assert str(out / "report.html") in outcome.out
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics["peaks"]) == {"SEP", "DEP", "FEP"}
    for scores in metrics["peaks"].values():
        assert set(scores["parameters"]) == {"current_amplitude", "drift_time", "tail_slope"}
        tail = scores["parameters"]["tail_slope"]
        assert tail["iou"]["raw"] == 0
        assert tail["wasserstein"]["raw"] == pytest.approx(1e3 / 55, rel=0.03)
        assert scores["paired"]["raw"]["edge_rmse"] > 0.01


# Command, words, and a name for --out that is, holds or lies in one of its inputs.
REPLACING = """
simulate | --detector icpc --hits D/hits.lh5 | D/hits.lh5
simulate | --detector D/my.yaml --events FEP=1 | D/my.yaml
stand | --preset D/my.yaml | D
stand | --preset ornl --shift bias_V=20 --shift D/my.yaml | D
check | SIDES | D/data.lh5
check | SIDES --data-energy D/hits.lh5:ch1/hit/energy | D/hits.lh5
train | SIDES | D
train | --sim sim.lh5 --data data.lh5 --data-energy D/hits.lh5:ch1/hit/energy | D
calibrate | SIDES | D
translate | RUN D/sim.lh5 | D/sim.lh5
translate | RUN sim.lh5 | RUN/weights.safetensors
translate | RUN D/sim.lh5 --energy D/hits.lh5:energy | D/hits.lh5
validate | RUN SIDES | D
validate | RUN --sim sim.lh5 --data data.lh5 --truth D/truth.npz | D
info | D/sim.lh5 | D/sim.lh5
info | sim.lh5 --energy D/hits.lh5:energy | D/hits.lh5
compare | REPORT/metrics.json | REPORT/metrics.json
response | RUN | RUN
response | RUN --truth D | D
export onnx | RUN | RUN/weights.safetensors
export legend | RUN --report REPORT | REPORT
library make | --detector D/my.yaml | D/my.yaml
library make | --detector icpc --set D/my.yaml | D/my.yaml
library translate | RUN D/hits.lh5 | RUN/l.lh5
import | --ren D/fep_REN.pt | D
"""
SIDES = "--sim D/sim.lh5 --data D/data.lh5"
CASES = [row.split(" | ") for row in rows_of(REPLACING.replace("SIDES", SIDES))]


def writing_commands(below: App = app, name: str = "") -> set[str]:
    """Names of all commands that have ``--force``."""
    if below.default_command is not None:
        options = below.assemble_argument_collection(default_parameter=app.default_parameter)
        return {name} if any("--force" in option.names for option in options) else set()
    words = [word for word in below if word[0] != "-"]
    deeper = (writing_commands(below[word], f"{name} {word}".strip()) for word in words)
    return set().union(*deeper)


def test_every_command_that_writes_is_here():
    # a demonstration reads no file
    assert writing_commands() == {name for name, *_ in CASES} | {"demo"}


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
