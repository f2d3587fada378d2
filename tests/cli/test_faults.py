"""What the commands promise when the machine fails them, see docs/faults.md."""

from __future__ import annotations

import errno
import os
import pickle
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml
from torch import nn

from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes import load_recipe
from cpunet.training.run_folder import write_run

DETECTOR = {
    "crystal_length": 20.0, "crystal_radius": 20.0, "point_contact_length": 1.6,
    "point_contact_radius": 2.0, "li_thickness": 1.0, "impurity_z0_1e10_per_cm3": -0.8,
    "bias_V": 2500, "temperature_K": 85, "grid_mm": 0.5,
}  # fmt: skip
SIMULATE = "simulate --hits hits.npz --detector detector.yaml --out"
# Commands that write, by the kind of their output; what takes long writes by the same means.
COMMANDS = {
    "simulate": (SIMULATE, "out.lh5"),
    "fields": ("fields detector.yaml --no-paths --out", "out.png"),
    "stand": ("stand --preset legend200 --detector detector.yaml --events FEP=2 --out", "out"),
    "translate": ("translate RUN sim.lh5 --insist --out", "out.lh5"),
    "compare": ("compare REPORT REPORT2 --out", "out.html"),
    "response": ("response LEARNED --out", "out"),
    "export": ("export RUN --format torchscript --out", "out.pt"),
    "library make": (
        "library make --detector detector.yaml --grid-mm 12 --dt-ns 16 --length-ns 3600 --out",
        "out.lh5",
    ),
    "import pulses": ("import pulses pulses.pickle --out", "out.lh5"),
    "train": ("train --sim sim.lh5 --data data.lh5 TINY --out", "out"),
    "library lithium": ("library lithium --out", "out.lh5"),
}
# Those that take several seconds each, or write in the same way as one of the above.
SLOW_COMMANDS = {
    "info": ("info data.lh5 --without-remains", "out.lh5"),
    "library translate": ("library translate LEARNED psl.lh5 --out", "out.lh5"),
    "library merge": ("library merge psl.lh5 --out", "out.lh5"),
    "validate": ("validate RUN --sim sim.lh5 --data data.lh5 --no-rivals --out", "out"),
    "check": ("check --sim sim.lh5 --data data.lh5 --out", "out.png"),
    "export parameters": ("export LEARNED --to legend-pars --out", "out"),
}
# Those that draw or trace before they write.
SECONDS = ("fields", "response", "export")
ALL_COMMANDS = [
    *(
        pytest.param(name, marks=[pytest.mark.thorough] if name in SECONDS else [])
        for name in COMMANDS
    ),
    *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW_COMMANDS),
]
SCORES = '{"peaks": {"FEP": {"parameters": {"drift_time": {"iou": {"ren": 80.0}}}}}}'


@pytest.fixture
def home(run: Path, stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with inputs of all commands."""
    monkeypatch.chdir(tmp_path)
    run.rename("RUN")
    Path("sim.lh5").symlink_to(stand.sim)
    Path("data.lh5").symlink_to(stand.data)
    Path("detector.yaml").write_text(yaml.safe_dump(DETECTOR))
    x = np.array([5.0, 6.0, 9.0])
    hits = {"x_mm": x, "y_mm": 0 * x, "z_mm": x + 4, "edep_keV": 0 * x + 900}
    np.savez("hits.npz", **hits, offsets=np.array([0, 1, 2, 3]))
    pulse = {"wf": np.linspace(0, 1, 200), "tp0": 40, "energy": 2614.5, "event": 1}
    Path("pulses.pickle").write_bytes(pickle.dumps([pulse] * 20))
    for report in ("REPORT", "REPORT2"):
        Path(report).mkdir()
        Path(report, "metrics.json").write_text(SCORES)
    recipe = load_recipe("fast")
    info = {"recipe": "fast", "dt_ns": 16.0, "peak": "FEP", "seconds": 0, "seed": 0}
    Path("LEARNED").mkdir()
    model = nn.ModuleDict({"ren": ResponseGenerator(recipe.matching.generator, 16.0)})
    write_run(Path("LEARNED"), model, recipe, info | {"device": "cpu"})
    return tmp_path


def words_of(name: str, tiny: list[str]) -> list[str]:
    words, out = (COMMANDS | SLOW_COMMANDS)[name]
    found = [*words.split(), out]
    at = found.index("TINY") if "TINY" in found else None
    return found if at is None else [*found[:at], *tiny, *found[at + 1 :]]


def ready_words(command, name: str, tiny: list[str]) -> list[str]:
    """Words of a command, whose inputs are made if they are not there yet."""
    words = words_of(name, tiny)
    if "psl.lh5" in words:
        assert command(*COMMANDS["library make"][0].split(), "psl.lh5").code == 0
    return words


def listing(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@contextmanager
def full_disk() -> Iterator[None]:
    """No file may become larger than 100 bytes: "File too large" in place of "No space"."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def refusing(number: int) -> Callable[..., None]:
    def refuse(*_given: object, **_options: object) -> None:
        raise OSError(number, os.strerror(number))

    return refuse


def ended_by(number: int) -> Callable[..., None]:
    return lambda *_given, **_options: signal.raise_signal(number)


# fault → what fails with it; moving the output into its place is the last that happens
FAULTS = {
    "EIO as it is moved into place": ("pathlib.Path.replace", refusing(errno.EIO)),
    "ESTALE as it is moved into place": ("pathlib.Path.replace", refusing(errno.ESTALE)),
    "SIGTERM as it is moved into place": ("pathlib.Path.replace", ended_by(signal.SIGTERM)),
    "read-only": ("pathlib.Path.touch", refusing(errno.EROFS)),
}
FOLDER_FAULTS = {"read-only": ("pathlib.Path.mkdir", refusing(errno.EROFS))}


def require_failed(outcome, before: dict[str, bytes], folder: Path, status: int) -> None:
    assert outcome.code == status, outcome.err
    lines = outcome.err.splitlines()
    assert [line for line in lines if line.startswith("error: ")] == lines[-1:]
    assert "Traceback" not in outcome.err
    after = listing(folder)
    assert {name: after.get(name) for name in before} == before
    # what a killed training would go on from has no output's name
    assert all(name.startswith("out.unfinished/") for name in after.keys() - before.keys())


# of two that fail alike, one is enough for what takes long
SLOW = "ESTALE as it is moved into place"


@pytest.mark.parametrize(
    "fault",
    [pytest.param(f, marks=[pytest.mark.slow] if f == SLOW else []) for f in FAULTS],
)
@pytest.mark.parametrize("name", ALL_COMMANDS)
def test_a_fault_leaves_one_line_and_nothing_else(
    command, home, tiny, monkeypatch, name, fault
):
    words = ready_words(command, name, tiny)
    is_folder = not Path(words[-1]).suffix
    what, instead = (FOLDER_FAULTS if is_folder else {}).get(fault, FAULTS[fault])
    if name == "train" and fault == "read-only":
        pytest.skip("makes its folder first")
    before = listing(home)
    with monkeypatch.context() as patched:
        patched.setattr(what, instead)
        outcome = command(*words)
    status = 128 + signal.SIGTERM if "SIGTERM" in fault else 2
    require_failed(outcome, before, home, status)


@pytest.mark.parametrize("name", [p for p in ALL_COMMANDS if p.values != ("train",)])
def test_a_full_disk_leaves_one_line_and_nothing_else(command, home, tiny, name):
    words = ready_words(command, name, tiny)
    before = listing(home)
    with full_disk():
        outcome = command(*words)
    require_failed(outcome, before, home, 2)
    assert "File too large" in outcome.err.splitlines()[-1]


@pytest.mark.parametrize(
    "name",
    ["simulate", "compare", pytest.param("response", marks=pytest.mark.thorough), "stand"],
)
def test_what_was_there_stays_if_its_replacement_fails(command, home, tiny, monkeypatch, name):
    words = words_of(name, tiny)
    assert command(*words).code == 0
    before = listing(home)
    for fault, (what, instead) in FAULTS.items():
        if fault == "read-only" and not Path(words[-1]).suffix:
            what, instead = FOLDER_FAULTS[fault]
        with monkeypatch.context() as patched:
            patched.setattr(what, instead)
            outcome = command(*words, "--force")
        require_failed(outcome, before, home, 143 if "SIGTERM" in fault else 2)


def killed_at_the_move(held: ModuleType, words: list[str], told: Path) -> int:
    """Run a command in a process that is killed as its output is moved into place."""
    given = {"words": words, "folder": str(Path.cwd()), "told": str(told)}
    job = held.forked(str(Path(__file__).with_name("killed.py")), {"GIVEN": given})
    job.join()
    assert job.exitcode < 0, told.read_text()
    return int(job.exitcode)


KILLED_COMMANDS = ["translate", "compare"]
MORE_KILLED_COMMANDS = sorted(
    (COMMANDS | SLOW_COMMANDS).keys() - {*KILLED_COMMANDS, "simulate", "library make", "train"}
)


@pytest.mark.parametrize(
    "name",
    [
        *KILLED_COMMANDS,
        *(
            pytest.param(name, marks=pytest.mark.thorough)
            for name in ("simulate", "library make")
        ),
        *(pytest.param(name, marks=pytest.mark.slow) for name in MORE_KILLED_COMMANDS),
    ],
)
def test_what_was_killed_has_left_no_output_and_can_be_done_again(
    command, home, tiny, held, tmp_path_factory, name
):
    words = ready_words(command, name, tiny)
    before = set(listing(home))
    if "detector.yaml" in words:  # its fields are moved into the cache, too
        assert command("fields", "detector.yaml").code == 0
    told = tmp_path_factory.mktemp("told") / "told"
    assert killed_at_the_move(held, words, told) == -signal.SIGKILL
    left = set(listing(home)) - before
    assert all(Path(path).name.startswith(f".{Path(words[-1]).stem}") for path in left)
    assert command(*words).code == 0
    assert Path(words[-1]).exists()
    if name == "translate":  # which cleans up after the dead
        assert set(listing(home)) - before == {words[-1]}


@pytest.mark.parametrize("name", ["simulate", "stand", "compare", "library lithium"])
def test_of_two_writers_the_last_is_whole(command, home, tiny, monkeypatch, name):
    """Another process ends with the same output while this one is about to."""
    words = words_of(name, tiny)
    with monkeypatch.context() as patched:
        replace, second = Path.replace, list[int]()

        def after_another(path: Path, target: Path) -> Path:
            if not second and Path(target).name == words[-1]:
                second.append(0)
                second.append(command(*words, "--force").code)
            return replace(path, target)

        patched.setattr("pathlib.Path.replace", after_another)
        first = command(*words, "--force")
    assert second == [0, 0]
    assert first.code == 0, first.err
    assert command(*words).code == 2  # it is there, and
    assert command(*words, "--force").code == 0  # is known as this program's own
    assert not [name for name in listing(home) if ".partial" in name]


@pytest.mark.parametrize("name", ["simulate", "translate", "train"])
def test_a_clock_that_goes_backwards(command, home, tiny, monkeypatch, name):
    now = time.time()
    ticks = iter(range(10**9))
    with monkeypatch.context() as patched:
        patched.setattr("time.time", lambda: now - 3600 * next(ticks))
        assert command(*words_of(name, tiny)).code == 0
