"""A run and its folder: read back what was written, and one line for every damage."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from cpunet.errors import CpunetError
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.recipes import load_recipe
from cpunet.training.cyclegan import CycleGan
from cpunet.training.run import FORMAT, WEIGHTS, Run, append_losses, read_losses, versions
from synthetic import write_run

INFO = {"recipe": "paper", "peak": "FEP", "seed": 1, "dt_ns": 16.0}
INFO |= {"seconds": 1.5, "device": "cpu"}


@pytest.fixture
def recipe(tiny):
    return tiny("discriminator.value_range=[-0.1, 1.1]")


@pytest.fixture
def model(recipe) -> CycleGan:
    return CycleGan(recipe)


@pytest.fixture
def run(tmp_path: Path, model, recipe) -> Path:
    write_run(tmp_path, model, recipe, INFO)
    return tmp_path


def blank(recipe) -> PositionalUNet:
    return PositionalUNet(recipe.generator, recipe.preparation.length)


def test_everything_comes_back(run, model, recipe):
    found = Run.load(run)
    assert json.loads((run / "run.json").read_text()) == {"format": FORMAT} | INFO
    assert (found.recipe, found.folder, found.seed, found.fit) == (recipe, run, 1, None)
    for name in ("ren", "iren", "discriminator_data", "discriminator_sim"):
        fresh = getattr(CycleGan(recipe), name)
        loaded = found.fill(name, fresh.train())
        assert not loaded.training
        saved = getattr(model, name).state_dict()
        assert all(torch.equal(saved[k], v) for k, v in loaded.state_dict().items())


def test_the_weights_are_safetensors_and_no_pickle(run, model):
    with safe_open(run / "weights.safetensors", "pt") as file:
        assert set(file.keys()) == set(model.state_dict())
    head = (run / "weights.safetensors").read_bytes()
    length = int.from_bytes(head[:8], "little")
    assert isinstance(json.loads(head[8 : 8 + length]), dict)


def test_losses_are_appended(tmp_path):
    assert read_losses(tmp_path) == []
    records = [
        {"iteration": i, "rate": 1e-3 / 3**i, "losses": {"cycle_forward": 0.1 * i}}
        for i in range(5)
    ]
    append_losses(tmp_path, records[:2])
    append_losses(tmp_path, records[2:])
    assert read_losses(tmp_path) == records
    assert len((tmp_path / "losses.jsonl").read_text().splitlines()) == 5


def test_versions_name_what_shapes_the_result():
    found = versions()
    assert {"python", "cpunet", "torch", "numpy"} <= found.keys()
    assert found["torch"] == torch.__version__.split("+")[0] or found["torch"] == (
        torch.__version__
    )


def one_line(error: pytest.ExceptionInfo[CpunetError], *parts: str) -> None:
    text = str(error.value)
    assert "\n" not in text
    for part in parts:
        assert part in text


def test_weights_of_another_architecture(run, tiny):
    with pytest.raises(CpunetError) as error:
        Run.load(run).fill("ren", blank(tiny("generator.width=4")))
    one_line(error, "weights.safetensors: weights of another network", "tensors differ")


def test_weights_without_the_part_wanted(run, recipe):
    with pytest.raises(CpunetError) as error:
        Run.load(run).fill("other", blank(recipe))
    one_line(error, "weights.safetensors: weights of another network")


def test_missing_weights(run, recipe):
    (run / "weights.safetensors").unlink()
    with pytest.raises(CpunetError) as error:
        Run.load(run).fill("ren", blank(recipe))
    one_line(error, "weights.safetensors: no readable weights; train again")


@given(part=st.floats(0, 1, exclude_max=True))
def test_truncated_weights(tmp_path_factory, part):
    # made once, cut anew each time: hypothesis keeps function-scoped fixtures

    folder = tmp_path_factory.mktemp("run")
    network = torch.nn.Linear(3, 2)
    write_run(folder, torch.nn.ModuleDict({"ren": network}), load_recipe("paper"), INFO)
    path = folder / "weights.safetensors"
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(CpunetError) as error:
        Run.load(folder)
    one_line(error, str(path), "train again")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04" + bytes(500), b"\xff" * 500, b"{}"])
def test_foreign_weights(run, recipe, content):
    (run / "weights.safetensors").write_bytes(content)
    with pytest.raises(CpunetError) as error:
        Run.load(run).fill("ren", blank(recipe))
    one_line(error, "weights.safetensors: no readable weights; train again")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no finished run"),
        ("", "run.json: damaged"),
        ('{"dt_ns": 16', "run.json: damaged"),
        ("[1]", "run.json: damaged (no mapping)"),
        ('{"format": 2, "dt_ns": 16}', "run.json: damaged (no peak)"),
    ],
)
def test_damaged_info(run, text, message):
    (run / "run.json").unlink()
    if text is not None:
        (run / "run.json").write_text(text)
    with pytest.raises(CpunetError) as error:
        Run.load(run)
    one_line(error, str(run), message)


# What is wrong with run.json: key and value
WRONG_FACTS = [
    *(("dt_ns", v) for v in (None, "16", -16)),
    *(("peak", v) for v in (None, 3)),
    ("seed", -1),
    ("data", {"cuts": 3}),
    ("fit", {"errors": [1]}),
    ("fit", {"chi_square": "9"}),
    ("fit", {"noise": 3}),
]


@pytest.mark.parametrize(("key", "value"), WRONG_FACTS)
def test_facts_of_other_types(run, key, value):
    (run / "run.json").write_text(json.dumps(INFO | {"format": FORMAT, key: value}))
    with pytest.raises(CpunetError) as error:
        Run.load(run)
    one_line(error, str(run), "run.json: damaged (", key)


@pytest.mark.parametrize("version", [FORMAT - 1, FORMAT + 1, "2"])
def test_a_run_of_another_version_is_not_called_damaged(run, version):
    (run / "run.json").write_text(json.dumps(INFO | {"format": version}))
    with pytest.raises(CpunetError) as error:
        Run.load(run)
    assert f"{run / 'run.json'}: of another version of cpunet (format {version}" in str(
        error.value
    )


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1" * 400, "1" * 5000, "1e400"])
def test_facts_beyond_all_numbers(run, number):
    (run / "run.json").write_text(json.dumps(INFO | {"format": FORMAT}).replace("16.0", number))
    with pytest.raises(CpunetError) as error:
        Run.load(run)
    one_line(error, str(run), "run.json: damaged (")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w.fill_(torch.nan), "is not finite; train again"),
        (lambda w: w.view(-1)[:1].fill_(torch.inf), "is not finite; train again"),
        (lambda w: w.zero_(), "all weights of ren are zero; train again"),
    ],
)
def test_weights_that_are_no_numbers(run, recipe, change, message):
    weights = load_file(run / WEIGHTS)
    for values in weights.values():
        if values.is_floating_point():
            change(values)
    save_file(weights, run / WEIGHTS)
    with pytest.raises(CpunetError) as error:
        Run.load(run).fill("ren", blank(recipe))
    one_line(error, WEIGHTS, message)


@pytest.mark.parametrize("text", [None, "", "{", "name: x", "- 1", "a: [\n"])
def test_damaged_recipe(run, text):
    (run / "recipe.yaml").unlink()
    if text is not None:
        (run / "recipe.yaml").write_text(text)
    with pytest.raises(CpunetError) as error:
        Run.load(run)
    one_line(error, str(run / "recipe.yaml"))


@pytest.mark.parametrize(
    "text",
    [
        '{"iteration": 0',
        "x\n",
        "\n\n[1",
        "[]",
        "3",
        '{"iteration": 1, "losses": [2]}',
        '{"iteration": "1", "losses": {}}',
        '{"iteration": 1, "losses": {"a": "b"}}',
        "\xff",
    ],
)
def test_a_damaged_log(run, text):
    (run / "losses.jsonl").write_text(text)
    with pytest.raises(CpunetError) as error:
        read_losses(run)
    one_line(error, "losses.jsonl: damaged")


def test_a_run_in_memory_is_saved_with_its_losses(run, model, recipe, tmp_path_factory):
    (record,) = records = [{"iteration": 1, "rate": 0.1, "losses": {"cycle": 2.0, "gan": 1.0}}]
    append_losses(run, records)
    known, copy = Run.load(run), tmp_path_factory.mktemp("saved") / "copy"
    assert known.losses.to_dict("records") == [
        {"iteration": 1, "rate": 0.1, **record["losses"]}
    ]
    known.save(copy)
    with pytest.raises(CpunetError, match="exists"):
        known.save(copy)
    for name in ("run.json", "recipe.yaml", "losses.jsonl", WEIGHTS):
        assert (copy / name).read_bytes() == (run / name).read_bytes()
    digest = hashlib.sha256((run / WEIGHTS).read_bytes()).hexdigest()
    assert known.weights_sha256 == digest
    made = Run.of(model, recipe, peak="FEP", seed=1, dt_ns=16, seconds=1.5, device="cpu")
    assert (made.weights_sha256, made.records) == (digest, [])
    assert repr(made) == "<Run run in memory: paper, FEP>"
