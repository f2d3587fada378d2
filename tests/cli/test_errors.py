"""Bad input: status 2, one line that names the file, and nothing left behind."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest


def listing(folder: Path) -> list[str]:
    """Every name in a folder, hidden ones too."""
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def refused(command, tmp_path) -> Callable[..., str]:
    """Call a command that must fail; return its error, the last line of stderr."""

    def call(*words: object) -> str:
        before = listing(tmp_path)
        outcome = command(*words)
        assert outcome.code == 2
        assert outcome.out == ""
        lines = outcome.err.splitlines()
        assert [line.startswith("error:") for line in lines] == [False] * (len(lines) - 1) + [
            True
        ]
        assert "Traceback" not in outcome.err
        assert listing(tmp_path) == before
        return lines[-1]

    return call


@pytest.fixture
def out(tmp_path) -> Path:
    (tmp_path / "results").mkdir()
    return tmp_path / "results" / "out.lh5"


@pytest.fixture
def train_refused(refused, stand, tiny, out) -> Callable[..., str]:
    def call(*words: object, sim: Path = stand.sim, data: Path = stand.data) -> str:
        line = refused("train", "--sim", sim, "--data", data, "--out", out, *tiny, *words)
        assert listing(out.parent) == []
        return line

    return call


@pytest.fixture
def validate_refused(refused, stand, trained, out) -> Callable[..., str]:
    def call(
        *words: object, run: Path = trained, sim: Path = stand.sim, data: Path = stand.data
    ) -> str:
        line = refused("validate", run, "--sim", sim, "--data", data, "--out", out, *words)
        assert listing(out.parent) == []
        return line

    return call


@pytest.fixture
def translate_refused(refused, stand, trained, out) -> Callable[..., str]:
    def call(*words: object, run: Path = trained, source: Path = stand.sim) -> str:
        line = refused("translate", run, source, "--out", out, *words)
        assert listing(out.parent) == []
        return line

    return call


# What may be wrong with measured pulses: name → (change, part of the message).
DATA_DEFECTS = {
    "all-nan": (lambda w: np.full(w.shape, np.nan, np.float32), "nan"),
    "constant": (lambda w: np.full_like(w, 8000), "constant"),
    "saturated": (lambda w: np.minimum(w, 20_000), "saturated"),
    "short": (lambda w: w[:, 300:900], "window_outside_record"),
    "negative": (lambda w: 60_000 - w, ""),
}


@pytest.mark.parametrize("defect", DATA_DEFECTS)
def test_measured_pulses_that_cannot_be_used(
    train_refused, validate_refused, stand, tmp_path, defect
):
    change, part = DATA_DEFECTS[defect]
    data = tmp_path / f"{defect}.lh5"
    stand.write(data, "geds/raw", change(stand.data_waveforms), stand.data_kev)
    for call in (train_refused, validate_refused):
        line = call(data=data)
        assert line.startswith(f"error: {data}: ")
        assert part in line
        assert "; " in line  # what to do


@pytest.mark.parametrize("defect", ["all-nan", "constant"])
def test_simulated_pulses_that_cannot_be_used(
    train_refused, validate_refused, translate_refused, stand, tmp_path, defect
):
    change, part = DATA_DEFECTS[defect]
    sim = tmp_path / f"{defect}.lh5"
    stand.write(sim, "geds/sim", change(stand.sim_waveforms), stand.sim_kev, units="")
    lines = [train_refused(sim=sim), validate_refused(sim=sim), translate_refused(source=sim)]
    for line in lines:
        assert line.startswith(f"error: {sim}: ")
        assert part in line


def test_raw_data_are_no_input_of_the_inverse_if_too_short(translate_refused, stand):
    line = translate_refused("--inverse", "--insist")  # of the simulated pulses
    assert line.startswith(f"error: {stand.sim}: none of ")
    assert "are these measured pulses?" in line


def test_other_sampling_periods(
    train_refused, validate_refused, translate_refused, stand, tmp_path
):
    sim = tmp_path / "sim10.lh5"
    stand.write(sim, "geds/sim", stand.sim_waveforms, stand.sim_kev, units="", dt_ns=10)
    for call in (train_refused, validate_refused):
        line = call(sim=sim)
        assert line == (
            f"error: {sim}: sampled every 10 ns, but {stand.data} every 16 ns; "
            "resample one of them"
        )
    line = translate_refused(source=sim)
    assert line.startswith(f"error: {sim}: sampled every 10 ns, the run was trained on 16 ns")


def test_a_run_of_another_sampling_period(validate_refused, stand, tmp_path):
    """Both files agree with each other, but not with the run."""
    sim, data = tmp_path / "sim10.lh5", tmp_path / "data10.lh5"
    stand.write(sim, "geds/sim", stand.sim_waveforms, stand.sim_kev, units="", dt_ns=10)
    stand.write(data, "geds/raw", stand.data_waveforms, stand.data_kev, dt_ns=10)
    line = validate_refused(sim=sim, data=data)
    assert "sampled every 10 ns, the run was trained on 16 ns" in line


@pytest.mark.parametrize("side", ["sim", "data"])
def test_an_empty_peak(train_refused, stand, tmp_path, side):
    waveforms, kev = getattr(stand, f"{side}_waveforms"), getattr(stand, f"{side}_kev")
    path = tmp_path / "empty.lh5"
    stand.write(path, f"geds/{'sim' if side == 'sim' else 'raw'}", waveforms, 0 * kev + 1000)
    line = train_refused(**{side: path})
    assert line.startswith(f"error: {path}: none of {len(kev)} pulses can be used ")
    assert "energy_outside_selection" in line


@pytest.mark.parametrize("content", ["truncated", "foreign", "empty", "missing", "folder"])
def test_files_that_cannot_be_read(
    train_refused, validate_refused, translate_refused, refused, stand, tmp_path, content
):
    path = tmp_path / "bad.lh5"
    if content == "truncated":
        whole = stand.sim.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
    elif content == "foreign":
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(600))
    elif content == "empty":
        path.touch()
    elif content == "folder":
        path.mkdir()
    lines = [train_refused(sim=path), train_refused(data=path)]
    lines += [validate_refused(sim=path), validate_refused(data=path)]
    lines += [translate_refused(source=path), refused("info", path)]
    for line in lines:
        assert line.startswith(f"error: {path}: ")


def test_a_file_that_breaks_off_while_being_read(
    translate_refused, train_refused, stand, tmp_path
):
    """The header is whole and the waveforms are not: found after the output was begun."""
    import h5py

    path = Path(shutil.copy(stand.sim, tmp_path / "broken.lh5"))
    with h5py.File(path, "r+") as file:
        values = file["geds/sim/waveform/values"]
        if values.chunks is None:
            offset, size = values.id.get_offset(), values.id.get_storage_size()
        else:
            info = values.id.get_chunk_info(values.id.get_num_chunks() - 1)
            offset, size = info.byte_offset, info.size
        filters = values.compression
    content = bytearray(path.read_bytes())
    content[offset : offset + size] = b"\xff" * size
    path.write_bytes(content)
    for call in (lambda: translate_refused(source=path), lambda: train_refused(sim=path)):
        line = call()
        assert line.startswith(f"error: {path}: "), filters


def test_wrong_tables(train_refused, validate_refused, translate_refused, refused, stand):
    lines = [train_refused("--sim-table", "geds/none"), validate_refused("--sim-table", "x")]
    lines += [
        translate_refused("--table", "geds/none"),
        refused("info", stand.sim, "--table", "x"),
    ]
    for line in lines:
        assert line.startswith(f"error: {stand.sim}: ")
    assert train_refused("--data-table", "geds/none").startswith(f"error: {stand.data}: ")


def test_a_run_folder_that_exists(refused, stand, tiny, tmp_path):
    (tmp_path / "run").mkdir()
    line = refused("train", *stand.inputs, "--out", tmp_path / "run", *tiny)
    assert line == (
        f"error: {tmp_path / 'run'}: exists already; choose another name or give --force"
    )


def test_a_failed_training_does_not_replace_a_run(command, run, stand, tiny):
    before = (run / "weights.safetensors").read_bytes()
    words = ("--out", run, "--force", *tiny, "--set", "training.rate_generators=1e30")
    outcome = command("train", *stand.inputs, *words)
    assert outcome.code == 2
    assert outcome.err.splitlines()[-1].startswith("error: training diverged: ")
    assert (run / "weights.safetensors").read_bytes() == before
    assert listing(run.parent) == [run.name]


def test_folders_that_are_no_runs(validate_refused, translate_refused, refused, tmp_path):
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "empty", tmp_path / "none", tmp_path / "file"):
        if path.name == "file":
            path.write_text("no run")
        for call in (validate_refused, translate_refused):
            assert call(run=path).startswith(f"error: {path}: ")
        assert refused("info", path).startswith(f"error: {path}: ")


@pytest.mark.parametrize("name", ["run.json", "recipe.yaml", "weights.safetensors"])
@pytest.mark.parametrize("damage", ["missing", "empty", "half", "foreign"])
def test_damaged_runs(validate_refused, translate_refused, run, name, damage):
    path = run / name
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        damaged = {"empty": b"", "half": content[: len(content) // 2], "foreign": b"\xff" * 99}
        path.write_bytes(damaged[damage])
    for call in (validate_refused, translate_refused):
        assert call(run=run).startswith(f"error: {run}")


def test_weights_of_another_architecture(translate_refused, run):
    recipe = run / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace("width: 2", "width: 4"))
    line = translate_refused(run=run)
    assert "weights.safetensors: weights of another network" in line


def test_wrong_settings(train_refused, tmp_path):
    assert "error: none: neither a file" in train_refused("--recipe", "none")
    assert "training.none: no such setting" in train_refused("--set", "training.none=1")
    line = train_refused("--set", "training.batch_size=x")
    assert line.startswith("error: small: training.")
    assert "batch_size: " in line
    assert "expected KEY=VALUE" in train_refused("--set", "training.batch_size")
    line = train_refused("--peak", "TEP")
    assert "'TEP' is no known peak (FEP, SEP, DEP)" in line
    assert "device 'gpu' is not known" in train_refused("--device", "gpu")
    line = train_refused("--set", "discriminator.samples_per_step=7")
    assert "samples_per_step (7)" in line


@pytest.mark.parametrize("kind", ["length", "name", "text", "missing", "shape", "pickle"])
def test_truth_of_another_file(validate_refused, stand, tmp_path, kind):
    path = tmp_path / "truth.npz"
    response = np.load(stand.truth)["response"]
    if kind == "length":
        np.savez(path, response=response[:-1])
    elif kind == "name":
        np.savez(path, answer=response)
    elif kind == "shape":
        np.savez(path, response=response[:, 0])
    elif kind == "pickle":
        np.savez(path, response=np.array([{}] * len(response)))
    elif kind == "text":
        path.write_text("no archive")
    assert validate_refused("--truth", path).startswith(f"error: {path}: ")


def test_names_with_brackets_are_printed_as_they_are(refused):
    line = refused("info", "none[bold]here[/bold].lh5")
    assert "none[bold]here[/bold].lh5: no such file" in line


@pytest.mark.parametrize(
    "words",
    [
        ("train",),
        ("unknown",),
        ("info", "x.lh5", "--unknown"),
        ("train", "--sim", "a", "--data", "b", "--out", "c", "--threads", "0"),
        ("train", "--sim", "a", "--data", "b", "--out", "c", "--threads", "100000"),
        ("validate", "r", "--sim", "a", "--data", "b", "--out", "c", "--seed", "-1"),
        ("translate", "r", "s", "--out", "o", "--realisations", "1000000"),
    ],
)
def test_wrong_usage(command, words):
    outcome = command(*words)
    assert (outcome.code, outcome.out) == (2, "")
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: ")
    assert line.endswith("--help")


@pytest.mark.parametrize("words", [(), ("library",), ("import",)])
def test_no_command_at_all(command, words):
    outcome = command(*words)
    assert outcome.code == 2
    assert "Usage" in outcome.out + outcome.err


@pytest.mark.parametrize("name", [[], ["train"], ["translate"], ["validate"], ["info"]])
def test_help(command, name):
    outcome = command(*name, "--help")
    assert outcome.code == 0
    assert "Usage" in outcome.out
    expected = {"train", "translate", "validate", "info"} if not name else {"--help"}
    assert all(word in outcome.out for word in expected)


def test_the_help_does_not_load_torch():
    program = (
        "import sys; import cpunet.cli.main; "
        "heavy = {'torch', 'lh5', 'lgdo', 'dspeed', 'matplotlib', 'scipy'}; "
        "sys.exit(', '.join(sorted(heavy & sys.modules.keys())) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.thorough
def test_the_installed_command(stand):
    executable = Path(sys.executable).parent / "cpunet"
    if not executable.is_file():
        pytest.skip("cpunet is not installed beside this Python")

    def run(program: list[object], *words: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*map(str, [*program, *words])], capture_output=True, text=True, check=False
        )

    assert "Usage" in run([sys.executable, "-m", "cpunet"], "--help").stdout
    assert run([executable], "info", stand.sim).returncode == 0
