"""Checkpoints: the same bits after a crash as without one, and one line if one is damaged."""

from __future__ import annotations

import io
import json
import shutil
from functools import partial
from pathlib import Path

import pytest
import torch

from cpunet import outputs
from cpunet.errors import CpunetError
from cpunet.training.adversarial import Game, train
from cpunet.training.run import LOSSES, WEIGHTS
from cpunet.training.unfinished import CHECKPOINT, UnfinishedRun, unfinished_folder
from games import game_of
from synthetic import nearly_full_disk

N = 5


def recipe_of(tiny, *overrides: str):
    return tiny(f"training.iterations={N}", "training.checkpoint_interval=2", *overrides)


def weights(game: Game) -> dict[str, bytes]:
    return {name: v.numpy().tobytes() for name, v in game.average.state_dict().items()}


def unfinished(folder: Path, **facts: object) -> UnfinishedRun:
    return UnfinishedRun(folder, facts)


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
    run = unfinished(folder)
    run.save(state(value))
    return run


def test_a_state_comes_back(tmp_path):
    run = kept(tmp_path, 1.0)
    run.save(state(2.0))
    assert str(unfinished(tmp_path).begin(resume=True)) == str(state(2.0))
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
        unfinished(tmp_path).begin(resume=True)


class Interrupted(BaseException):
    """As if the process had died there."""


def work(recipe, out: Path, *, resume=False, die=None, disk=None, seed=3):
    """Train in a folder, as the job does; `die` after so many records."""
    with unfinished_folder(out, resume=resume) as folder:
        run = unfinished(folder, recipe=recipe.model_dump(mode="json"), seed=seed)
        start = run.begin(resume=resume)

        def listen(records):
            run.records += records
            if die is not None and records[-1]["iteration"] >= die:
                raise Interrupted

        def save(state):
            with nearly_full_disk(disk if state["iteration"] == 4 and disk else 2**40):
                run.save(state)

        how = {"listener": listen, "save": save, "start": start}
        game = train(partial(game_of, recipe), seed, **how)
        out.mkdir()
        (out / WEIGHTS).write_bytes(b"".join(weights(game).values()))
        (out / LOSSES).write_text(json.dumps(run.records))


def content(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.fixture
def recipe(tiny):
    return recipe_of(tiny, "training.log_interval=1")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Where trainings are that several tests begin with."""
    return tmp_path_factory.mktemp("made")


@pytest.fixture
def whole(recipe, made) -> dict[str, bytes]:
    """What a training in one go leaves."""
    if not (made / "whole").exists():
        work(recipe, made / "whole")
        assert not (made / "whole.unfinished").exists()
    return content(made / "whole")


@pytest.fixture
def out(recipe, made, tmp_path) -> Path:
    """Of a training that died in its last iteration, after checkpoints at 2 and 4."""
    if not beside(made / "died").exists():
        with pytest.raises(Interrupted):
            work(recipe, made / "died", die=4)
    shutil.copytree(beside(made / "died"), beside(tmp_path / "run"))
    return tmp_path / "run"


def beside(out: Path) -> Path:
    return out.with_name(f"{out.name}.unfinished")


def test_a_training_that_died_is_finished(recipe, out, whole, caplog):
    caplog.set_level("INFO", "cpunet")
    assert {CHECKPOINT, outputs.MARKER} == content(beside(out)).keys()
    assert not out.exists()
    work(recipe, out, resume=True)
    assert caplog.messages == ["going on after 4 iterations"]
    assert content(out) == whole
    assert not beside(out).exists()


def test_without_resume_nothing_is_lost(recipe, out):
    before = content(beside(out))
    with pytest.raises(CpunetError, match=r"run\.unfinished: an unfinished training; continue"):
        work(recipe, out)
    assert content(beside(out)) == before


def test_another_recipe_or_seed(recipe, tiny, out):
    before = content(beside(out)).keys()
    other = recipe_of(tiny, "training.log_interval=1", "training.batch_size=5")
    with pytest.raises(
        CpunetError, match=r"^resumed with another recipe: training\.batch_size 4 → 5; give"
    ):
        work(other, out, resume=True)
    with pytest.raises(CpunetError, match=r"^resumed with another seed: 3 → 4; give"):
        work(recipe, out, resume=True, seed=4)
    assert content(beside(out)).keys() == before


def test_a_full_disk_does_not_stop_the_training(recipe, tmp_path, whole, caplog):
    out = tmp_path / "run"
    work(recipe, out, disk=3000)
    (note,) = caplog.messages
    assert note.startswith(f"{beside(out)}: no checkpoint after 4 iterations (")
    assert note.endswith("; the previous remains")
    assert content(out) == whole


def test_what_never_had_a_checkpoint_leaves_nothing(recipe, tmp_path):
    with pytest.raises(Interrupted):
        work(recipe, tmp_path / "run", die=0)
    assert list(tmp_path.iterdir()) == []
