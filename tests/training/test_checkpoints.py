"""Checkpoints: what was stored comes back, and one line if it cannot be used."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
import torch

from cpunet import outputs
from cpunet.errors import CpunetError
from cpunet.training.unfinished import CHECKPOINT, UnfinishedRun, unfinished_folder
from synthetic import nearly_full_disk

FACTS = {"recipe": {"training": {"batch_size": 4}}, "seed": 3}


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
    run = UnfinishedRun(folder, FACTS)
    run.records = [{"iteration": 6, "rate": 0.1, "losses": {}}]
    run.save(state(value))
    return run


def test_a_state_comes_back(tmp_path):
    run = kept(tmp_path, 1.0)
    run.save(state(2.0))
    again = UnfinishedRun(tmp_path, FACTS, resume=True)
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
        UnfinishedRun(tmp_path, FACTS, resume=True)


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
        assert UnfinishedRun(folder, FACTS, resume=True).state is not None
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
            UnfinishedRun(tmp_path, FACTS | changed, resume=True)


def test_a_full_disk_does_not_stop_the_training(tmp_path, caplog):
    run = kept(tmp_path, 1.0)
    with nearly_full_disk(300):
        run.save(state(2.0))
    (note,) = caplog.messages
    assert note.startswith(f"{tmp_path}: no checkpoint after 7 iterations (")
    assert note.endswith("; the previous remains")
    assert str(UnfinishedRun(tmp_path, FACTS, resume=True).state) == str(state(1.0))
