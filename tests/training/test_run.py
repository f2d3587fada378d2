"""Runs and checkpoints: what was written comes back, and one line for every damage."""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from cpunet import outputs
from cpunet.errors import CpunetError
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.training.run import FORMAT, WEIGHTS, Run, used_run
from cpunet.training.unfinished import CHECKPOINT, UnfinishedRun, unfinished_folder
from games import as_published, untrained
from synthetic import nearly_full_disk, one_line, write_run

INFO = {"recipe": "published", "peak": "FEP", "seed": 1, "dt_ns": 16.0}
INFO |= {"seconds": 1.5, "device": "cpu"}
RECIPE = as_published("discriminator.value_range=[-0.1, 1.1]")
BEGUN = {"recipe": {"training": {"batch_size": 4}}, "seed": 3}
NO_WEIGHTS = f"{WEIGHTS}: no readable weights; train again"


@pytest.fixture
def model() -> dict[str, nn.Module]:
    return untrained(RECIPE)


@pytest.fixture
def run(tmp_path: Path, model) -> Path:
    write_run(tmp_path, model, RECIPE, INFO)
    return tmp_path


def test_everything_comes_back(run, model):
    found = Run.load(run)
    assert json.loads((run / "run.json").read_text()) == {"format": FORMAT} | INFO
    assert (found.recipe, found.folder, found.seed, found.fit) == (RECIPE, run, 1, None)
    for name in ("ren", "iren", "discriminator_data", "discriminator_sim"):
        fresh = untrained(RECIPE)[name]
        loaded = found.fill(name, fresh.train())
        assert not loaded.training
        saved = model[name].state_dict()
        assert all(torch.equal(saved[k], v) for k, v in loaded.state_dict().items())


def facts(**changes: object) -> str:
    return json.dumps(INFO | {"format": FORMAT} | changes)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("run.json", None, "no finished run"),
        ("run.json", "[1]", "run.json: damaged (no mapping)"),
        ("run.json", '{"format": 3, "dt_ns": 16}', "run.json: damaged (no peak)"),
        ("run.json", facts(seed=-1), "run.json: damaged (seed"),
        ("run.json", facts(fit={"errors": [1]}), "run.json: damaged (fit"),
        ("run.json", facts(format=FORMAT + 1), "of another version of cpunet (format 4"),
        ("recipe.yaml", None, "recipe.yaml"),
        ("recipe.yaml", "name: x", "recipe.yaml"),
        *((WEIGHTS, content, NO_WEIGHTS) for content in (None, "", "PK\x03\x04" + 500 * "\0")),
    ],
)
def test_a_damaged_run_is_told(run, name, content, message):
    (run / name).unlink()
    if content is not None:
        (run / name).write_text(content)
    one_line(lambda: Run.load(run), str(run), message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w.view(-1)[:1].fill_(torch.nan), "is not finite; train again"),
        (lambda w: w.zero_(), "all weights of ren are zero; train again"),
    ],
)
def test_weights_of_another_architecture_or_no_numbers(run, change, message):
    other, own = (
        PositionalUNet(of.generator, 64) for of in (as_published("generator.width=4"), RECIPE)
    )
    parts = ("weights.safetensors: weights of another network", "tensors differ")
    one_line(lambda: Run.load(run).fill("ren", other), *parts)
    weights = load_file(run / WEIGHTS)
    for values in weights.values():
        if values.is_floating_point():
            change(values)
    save_file(weights, run / WEIGHTS)
    one_line(lambda: Run.load(run).fill("ren", own), WEIGHTS, message)


def test_a_run_in_memory_is_saved_with_its_losses(run, model, tmp_path_factory):
    (run / "losses.jsonl").write_text('{"iteration": 0')
    one_line(lambda: Run.load(run).records, "losses.jsonl: damaged")
    record = {"iteration": 1, "rate": 0.1, "losses": {"cycle": 2.0, "gan": 1.0}}
    (run / "losses.jsonl").write_text(json.dumps(record) + "\n")
    known, copy = Run.load(run), tmp_path_factory.mktemp("saved") / "copy"
    assert known.records == [record]
    known.save(copy)
    with pytest.raises(CpunetError, match="exists"):
        known.save(copy)
    for name in ("run.json", "recipe.yaml", "losses.jsonl", WEIGHTS):
        assert (copy / name).read_bytes() == (run / name).read_bytes()
    digest = hashlib.sha256((run / WEIGHTS).read_bytes()).hexdigest()
    assert known.weights_sha256 == digest
    made = Run.of(model, RECIPE, peak="FEP", seed=1, dt_ns=16, seconds=1.5, device="cpu")
    assert (made.weights_sha256, made.records) == (digest, [])
    assert repr(made) == "<Run run in memory: published, FEP>"


def test_who_uses_a_run_whose_own_verdict_is_bad_is_told(run, caplog):
    checks = {"chi_square": 9.0, "amplitude": 1.0, "z": 40.0, "z_ns": 64.0}
    checks |= {"beyond_ns": [32.0, 640.0], "off": {"top": 40.0}, "pulses": [900, 900]}
    (run / "run.json").write_text(facts(fit={"checks": checks}), encoding="utf-8")
    used = used_run(run)
    assert not used.ok
    assert "a bad fit" in repr(used)
    (warning,) = caplog.messages
    assert warning.startswith(f"{run}: the fit of this run is bad: the top is off by 40.0")
    assert "charges that are trapped" in warning
    good = checks | {"chi_square": 1.0, "z": 2.0, "beyond_ns": [], "off": {}}
    (run / "run.json").write_text(facts(fit={"checks": good}), encoding="utf-8")
    assert used_run(run).ok
    assert len(caplog.messages) == 1


def state(value: float = 0.0) -> dict:
    return {
        "iteration": 7,
        "model": {"a.b": torch.full((3, 2), value), "n": torch.tensor(5)},
        "decks": [{"order": torch.empty(0, dtype=torch.long)}, {"rate": 0.1 + 0.2}],
        "random": torch.arange(5, dtype=torch.uint8),
        "none": None,
    }


def kept(folder: Path, value: float = 0.0) -> UnfinishedRun:
    """A training that has stored a state."""
    run = UnfinishedRun(folder, BEGUN)
    run.records = [{"iteration": 6, "rate": 0.1, "losses": {}}]
    run.save(state(value))
    return run


def test_a_state_comes_back(tmp_path):
    run = kept(tmp_path, 1.0)
    run.save(state(2.0))
    again = UnfinishedRun(tmp_path, BEGUN, resume=True)
    assert str(again.state) == str(state(2.0))
    assert (again.records, again.started) == (run.records, run.started)
    assert again.resumed_at == [7]
    assert [p.name for p in tmp_path.iterdir()] == [CHECKPOINT]


def code(_: bytes) -> bytes:
    """An object that is not of plain data: nothing is executed."""
    torch.save({"state": Path("x").open}, stream := io.BytesIO())
    return stream.getvalue()


@pytest.mark.parametrize(
    "damage", [lambda _: b"", lambda _: b"\xff" * 100, lambda c: c[:-200], code]
)
def test_a_damaged_checkpoint_is_told(tmp_path, damage):
    kept(tmp_path, 1.0)
    path = tmp_path / CHECKPOINT
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(CpunetError, match=rf"{CHECKPOINT}: damaged; begin again with `force`"):
        UnfinishedRun(tmp_path, BEGUN, resume=True)


class Interrupted(BaseException):
    """As if the process had died there."""


def dying(out: Path, *, checkpoint: bool) -> None:
    with unfinished_folder(out) as folder:
        if checkpoint:
            kept(folder)
        raise Interrupted


def test_a_training_that_died_leaves_its_checkpoint_until_it_is_finished(tmp_path, caplog):
    caplog.set_level("INFO", "cpunet")
    out, folder = tmp_path / "run", tmp_path / "run.unfinished"
    with pytest.raises(Interrupted):
        dying(out, checkpoint=False)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(Interrupted):
        dying(out, checkpoint=True)
    left = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert left.keys() == {CHECKPOINT, outputs.MARKER}
    message = r"run\.unfinished: an unfinished training; continue"
    with pytest.raises(CpunetError, match=message), unfinished_folder(out):
        pass
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == left
    with unfinished_folder(out, resume=True):
        assert UnfinishedRun(folder, BEGUN, resume=True).state is not None
    assert caplog.messages == ["going on after 7 iterations"]
    assert list(tmp_path.iterdir()) == []


def test_another_recipe_or_seed(tmp_path):
    kept(tmp_path)
    other = {"recipe": {"training": {"batch_size": 5}}}
    for changed, difference in (
        (other, r"recipe: training\.batch_size 4 → 5"),
        ({"seed": 4}, "seed: 3 → 4"),
    ):
        with pytest.raises(CpunetError, match=rf"^resumed with another {difference}; give"):
            UnfinishedRun(tmp_path, BEGUN | changed, resume=True)


def test_a_full_disk_does_not_stop_the_training(tmp_path, caplog):
    run = kept(tmp_path, 1.0)
    with nearly_full_disk(300):
        run.save(state(2.0))
    (note,) = caplog.messages
    assert note.startswith(f"{tmp_path}: no checkpoint after 7 iterations (")
    assert note.endswith("; the previous remains")
    assert str(UnfinishedRun(tmp_path, BEGUN, resume=True).state) == str(state(1.0))
