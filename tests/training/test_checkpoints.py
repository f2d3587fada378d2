"""Checkpoints: the same bits after a crash as without one, and one line for every damage."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cpunet import outputs
from cpunet.errors import CpunetError
from cpunet.training.checkpoints import (
    CHECKPOINT,
    PREVIOUS,
    Checkpoint,
    differences,
    read_checkpoints,
    require_same,
    write_checkpoint,
)
from cpunet.training.loop import CheckpointHooks, StoppedError, train
from cpunet.training.run_folder import LOSSES, WEIGHTS
from cpunet.training.unfinished import MARKER, LossLog, UnfinishedRun, unfinished_folder
from synthetic import nearly_full_disk

N = 5

# Everything random, and everything that has a state.
VARIANTS = {
    "paper": (),
    "everything": (
        "generator.residual=true",
        "generator.dropout=0.0",
        "training.average_decay=0.5",
        "training.instance_noise=0.1",
        "training.discriminator_interval=1",
        "training.losses.gradient_penalty=1.0",
    ),
    "rare-judges": ("training.discriminator_interval=4", "training.average_decay=0.9"),
    "large-batches": ("training.batch_size=10", "generator.residual=true"),
    "fast-step": ("generator.width=16", "training.discriminator_interval=2"),
    "convolutional-judge": (
        "discriminator={name: conv, width: 2, layers: 2, kernel: 3, current_gain: 5.0}",
        "training.losses.gradient_penalty=1.0",
        "training.discriminator_interval=1",
        "training.precision=bf16",
    ),
}


def recipe_of(tiny, *overrides: str):
    return tiny(f"training.iterations={N}", "training.checkpoint_interval=2", *overrides)


def weights(model) -> dict[str, bytes]:
    return {name: value.numpy().tobytes() for name, value in model.state_dict().items()}


def straight(sets, recipe):
    records = []
    return weights(train(*sets, recipe, seed=3, listener=records.extend)), records


def until(iteration: int, sets, recipe, folder: Path) -> list:
    """Train up to an iteration; its state goes to a file, its records are returned."""
    records = []

    def save(state):
        write_checkpoint(folder, Checkpoint(state, {"done": len(records)}))

    hooks = CheckpointHooks(save, stop=lambda: len(asked) >= iteration or bool(asked.append(0)))
    asked = [0]
    with pytest.raises(StoppedError, match=f"^stopped after {iteration} of {N} iterations;"):
        train(*sets, recipe, seed=3, listener=records.extend, hooks=hooks)
    return records


# after which iteration each is stopped; those that are but other numbers of the others are slow
STOPS = {
    "paper": 1,
    "everything": 2,
    "rare-judges": 3,
    "large-batches": 4,
    "fast-step": 2,
    "convolutional-judge": 3,
}
MARKS = dict.fromkeys(("paper", "convolutional-judge"), pytest.mark.thorough)
MARKS |= dict.fromkeys(("everything", "rare-judges", "large-batches"), pytest.mark.slow)


@pytest.mark.parametrize(
    ("variant", "stop"),
    [pytest.param(name, stop, marks=MARKS.get(name, ())) for name, stop in STOPS.items()],
)
def test_a_resumed_training_ends_with_the_same_bits(tiny, sets, tmp_path, variant, stop):
    recipe = recipe_of(tiny, *VARIANTS[variant])
    expected, expected_records = straight(sets, recipe)
    records = until(stop, sets, recipe, tmp_path)
    (checkpoint, *_) = read_checkpoints(tmp_path)
    assert checkpoint.state["iteration"] == stop == checkpoint.facts["done"]
    torch.manual_seed(99)  # what happened in between does not matter
    hooks = CheckpointHooks(lambda _state: None, start=checkpoint.state)
    model = train(*sets, recipe, seed=3, listener=records.extend, hooks=hooks)
    assert weights(model) == expected
    assert records == expected_records


def state(value: float = 0.0) -> dict:
    return {
        "iteration": 7,
        "model": {"a.b": torch.full((3, 2), value), "n": torch.tensor(5)},
        "decks": [{"order": torch.empty(0, dtype=torch.long)}, {"rate": 0.1 + 0.2}],
        "random": torch.arange(5, dtype=torch.uint8),
        "none": None,
    }


def one(folder: Path) -> Checkpoint | None:
    return next(read_checkpoints(folder))


def same_tree(a, b) -> bool:
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b) and a.dtype == b.dtype
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same_tree(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same_tree, a, b))
    return a == b


def test_a_state_comes_back_and_the_previous_one_is_kept(tmp_path):
    assert list(read_checkpoints(tmp_path)) == []
    for value in (1.0, 2.0, 3.0):
        write_checkpoint(tmp_path, Checkpoint(state(value), {"value": value}))
    found = list(read_checkpoints(tmp_path))
    assert [checkpoint.facts for checkpoint in found] == [{"value": 3.0}, {"value": 2.0}]
    assert all(same_tree(c.state, state(c.facts["value"])) for c in found)
    assert sorted(p.name for p in tmp_path.iterdir()) == [PREVIOUS, CHECKPOINT]


def test_the_file_is_safetensors_with_json(tmp_path):
    write_checkpoint(tmp_path, Checkpoint(state(), {"value": 1}))
    content = (tmp_path / CHECKPOINT).read_bytes()
    head = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    told = json.loads(head.pop("__metadata__")["json"])
    assert told["facts"] == {"value": 1}
    assert told["state"]["iteration"] == 7
    assert {entry["dtype"] for entry in head.values()} == {"F32", "I64", "U8"}


@settings(max_examples=40)
@given(part=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7), cut=st.booleans())
def test_any_damage_is_noticed(tmp_path_factory, part, bit, cut):
    folder = tmp_path_factory.mktemp("damaged")
    write_checkpoint(folder, Checkpoint(state(1.0), {}))
    path = folder / CHECKPOINT
    content = bytearray(path.read_bytes())
    place = int(part * len(content))
    if cut:
        del content[place:]
    else:
        content[place] ^= 1 << bit
    path.write_bytes(content)
    found = one(folder)
    # a flipped bit may change nothing that is read, such as a space into a tab
    assert found is None or same_tree(found.state, state(1.0))
    if cut:
        assert found is None


@pytest.mark.parametrize("content", [b"", b"\x80\x04K\x01.", b"\xff" * 100])
def test_foreign_files_are_no_checkpoints(tmp_path, content):
    (tmp_path / CHECKPOINT).write_bytes(content)
    assert one(tmp_path) is None


def test_another_format_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("cpunet.training.checkpoints.FORMAT", 99)
    write_checkpoint(tmp_path, Checkpoint(state(), {}))
    monkeypatch.undo()
    with pytest.raises(
        CpunetError, match=r"checkpoint\.safetensors: written by another version"
    ):
        one(tmp_path)


def test_a_full_disk_leaves_the_old_checkpoints(tmp_path):
    for value in (1.0, 2.0):
        write_checkpoint(tmp_path, Checkpoint(state(value), {}))
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    for room in (0, 100, len(before[CHECKPOINT]) - 1):
        with nearly_full_disk(room), pytest.raises(OSError, match="too large"):
            write_checkpoint(tmp_path, Checkpoint(state(3.0), {}))
        assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_a_log_on_a_full_disk_loses_and_doubles_nothing(tmp_path):
    log = LossLog(tmp_path)
    log.cut(0)
    records = [{"iteration": i, "rate": 0.1, "losses": {}} for i in range(30)]
    log.add(records[:10])
    log.write()
    for i in range(10, 20):
        log.add(records[i : i + 1])
        with nearly_full_disk(log.length + 20), pytest.raises(OSError, match="too large"):
            log.write()
    log.add(records[20:])
    assert log.write(sync=True) == (tmp_path / LOSSES).stat().st_size
    lines = (tmp_path / LOSSES).read_text().splitlines()
    assert [json.loads(line) for line in lines] == records
    assert LossLog(tmp_path).length == log.length


class Interrupted(BaseException):
    """As if the process had died there."""


def work(sets, recipe, out: Path, notes: list, *, resume=False, die=None, disk=None, seed=3):
    """Train in a folder, as the job does; `die` after so many records."""
    with unfinished_folder(out, resume=resume) as folder:
        told = {"recipe": recipe.model_dump(mode="json"), "seed": seed}
        run = UnfinishedRun(folder, told, {"device": "cpu"}, notes.append)
        start = run.begin(resume=resume)

        def listen(records):
            run.log(records)
            if die is not None and records[-1]["iteration"] >= die:
                raise Interrupted

        def save(state):
            with nearly_full_disk(disk if state["iteration"] == 4 and disk else 2**40):
                run.save(state)

        hooks = CheckpointHooks(save, start)
        model = train(*sets, recipe, seed=seed, listener=listen, hooks=hooks)
        run.finish()
        (folder / WEIGHTS).write_bytes(b"".join(weights(model).values()))


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
def whole(sets, recipe, made) -> dict[str, bytes]:
    """What a training in one go leaves."""
    if not (made / "whole").exists():
        work(sets, recipe, made / "whole", notes := [])
        assert notes == []
        assert not (made / "whole.unfinished").exists()
    return content(made / "whole")


@pytest.fixture
def out(sets, recipe, made, tmp_path) -> Path:
    """Of a training that died in its last iteration, after checkpoints at 2 and 4."""
    if not beside(made / "died").exists():
        with pytest.raises(Interrupted):
            work(sets, recipe, made / "died", [], die=4)
    shutil.copytree(beside(made / "died"), beside(tmp_path / "run"))
    return tmp_path / "run"


def beside(out: Path) -> Path:
    return out.with_name(f"{out.name}.unfinished")


def test_a_training_that_died_is_finished(sets, recipe, out, whole):
    files = {CHECKPOINT, PREVIOUS, LOSSES, MARKER, outputs.MARKER}
    assert files == content(beside(out)).keys()
    assert not out.exists()
    # the log is ahead of the checkpoint, and is cut
    assert len((beside(out) / LOSSES).read_text().splitlines()) == 5
    work(sets, recipe, out, notes := [], resume=True)
    assert notes == ["going on after 4 iterations"]
    assert content(out) == whole
    assert not beside(out).exists()


def test_without_resume_nothing_is_lost(sets, recipe, out):
    before = content(beside(out))
    with pytest.raises(CpunetError, match=r"run\.unfinished: an unfinished training; continue"):
        work(sets, recipe, out, [])
    assert content(beside(out)) == before


def test_resume_without_a_training_begins_one(sets, recipe, tmp_path, whole):
    work(sets, recipe, tmp_path / "run", notes := [], resume=True)
    assert notes == ["no checkpoint to go on from; beginning at the beginning"]
    assert content(tmp_path / "run") == whole


@pytest.mark.parametrize("damage", ["cut", "gone"])
def test_a_damaged_checkpoint_is_replaced_by_the_previous(sets, recipe, out, whole, damage):
    path = beside(out) / CHECKPOINT
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-1])
    else:
        path.unlink()  # died between two renames
    work(sets, recipe, out, notes := [], resume=True)
    assert notes[-1] == "going on after 2 iterations"
    if damage == "cut":
        assert "damaged; going on from the previous one, after 2 iterations" in notes[0]
    assert content(out) == whole


def test_two_damaged_checkpoints(sets, recipe, out):
    for name in (CHECKPOINT, PREVIOUS):
        (beside(out) / name).write_bytes(b"nothing")
    with pytest.raises(CpunetError, match="no checkpoint is whole; begin again with --force"):
        work(sets, recipe, out, [], resume=True)


def test_a_log_that_is_behind_its_checkpoint(sets, recipe, out):
    path = beside(out) / LOSSES
    path.write_bytes(path.read_bytes()[:10])  # lost with the power
    with pytest.raises(CpunetError, match="no checkpoint is whole"):
        work(sets, recipe, out, [], resume=True)


def test_another_recipe_or_seed(sets, recipe, tiny, out, whole):
    before = content(beside(out)).keys()
    other = recipe_of(tiny, "training.log_interval=1", "training.batch_size=5")
    with pytest.raises(
        CpunetError, match=r"^resumed with another recipe: training\.batch_size 4 → 5; give"
    ):
        work(sets, other, out, [], resume=True)
    with pytest.raises(CpunetError, match=r"^resumed with another seed: 3 → 4; give"):
        work(sets, recipe, out, [], resume=True, seed=4)
    assert content(beside(out)).keys() == before
    work(sets, recipe, out, [], resume=True)
    assert content(out) == whole


def test_a_full_disk_does_not_stop_the_training(sets, recipe, tmp_path, whole):
    out = tmp_path / "run"
    work(sets, recipe, out, notes := [], disk=3000)
    (note,) = notes
    assert note.startswith(f"warning: {beside(out)}: no checkpoint after 4 iterations (")
    assert note.endswith("; the one before is kept")
    assert content(out) == whole


@pytest.mark.thorough
def test_after_a_full_disk_the_checkpoint_before_it_is_used(sets, recipe, tmp_path, whole):
    out = tmp_path / "run"
    with pytest.raises(Interrupted):
        work(sets, recipe, out, [], disk=3000, die=4)
    work(sets, recipe, out, notes := [], resume=True)
    assert notes == ["going on after 2 iterations"]
    assert content(out) == whole


def test_a_training_that_cannot_be_put_in_place_is_kept(tmp_path):
    out = tmp_path / "run"

    def end(folder: Path) -> None:
        write_checkpoint(folder, Checkpoint(state(), {}))
        out.mkdir()  # someone else's

    with (
        pytest.raises(CpunetError, match="finish it with --resume"),
        unfinished_folder(out) as folder,
    ):
        end(folder)
    assert (folder / CHECKPOINT).is_file()


def test_what_never_had_a_checkpoint_leaves_nothing(sets, recipe, tmp_path):
    with pytest.raises(Interrupted):
        work(sets, recipe, tmp_path / "run", [], die=0)
    assert list(tmp_path.iterdir()) == []


def test_a_foreign_folder_is_left_alone(tmp_path):
    mine = tmp_path / "run.unfinished"
    mine.mkdir()
    (mine / "thesis.tex").write_text("...")
    with (
        pytest.raises(CpunetError, match=r"run\.unfinished: is no folder that cpunet train"),
        unfinished_folder(tmp_path / "run", force=True),
    ):
        pass
    assert [p.name for p in mine.iterdir()] == ["thesis.tex"]


def test_two_processes_do_not_share_a_folder(tmp_path):
    with unfinished_folder(tmp_path / "run") as folder:
        write_checkpoint(folder, Checkpoint(state(), {}))
        with (
            pytest.raises(CpunetError, match="another process is training there"),
            unfinished_folder(tmp_path / "run", resume=True, force=True),
        ):
            pass
        assert (folder / CHECKPOINT).is_file()


def test_differences_are_named_in_full():
    then = {"a": {"b": 1, "c": [1, 2]}, "d": None, "gone": 1}
    now = {"a": {"b": 1.0, "c": (1, 3)}, "d": 2, "new": "x" * 64}
    assert list(differences(then, now)) == [
        "a.c [1, 2] → [1, 3]",
        "d None → 2",
        "gone 1 → none",
        "new none → xxxxxxxxxxxx…",
    ]
    require_same({"recipe": {"a": (1, 2)}}, {"recipe": {"a": [1, 2]}})
    with pytest.raises(CpunetError, match=r"^resumed with another peak: FEP → SEP;"):
        require_same({"peak": "FEP"}, {"peak": "SEP"})
