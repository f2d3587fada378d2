"""Files of an exported run, and its card with scores of reports, whatever is in them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from cpunet.errors import CpunetError
from cpunet.jobs.translation.export import _score_table, export_run
from cpunet.networks.linear_inverse import LinearInverse, Sizes
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.recipes import load_recipe
from cpunet.translation import exports
from synthetic import write_run

INFO = {
    "recipe": "fast",
    "peak": "FEP",
    "seed": 0,
    "dt_ns": 16.0,
    "seconds": 1,
    "device": "cpu",
}


def write_chain(folder: Path) -> Path:
    """A readout chain that was not fitted, with its inverse."""
    recipe = load_recipe("fast")
    chain = ResponseGenerator(recipe.matching.generator, 16.0)
    folder.mkdir()
    inverse = LinearInverse(Sizes.of(recipe.preparation.length, recipe.matching.training))
    inverse.half_height.fill_(0.4)
    inverse.weights.copy_(torch.eye(len(inverse.weights)))
    model = nn.ModuleDict({"ren": chain, "iren": inverse})
    write_run(folder, model, recipe, INFO)
    return folder


def test_old_noise_does_not_stay_beside_a_new_export(tmp_path: Path) -> None:
    out = tmp_path / "out" / "ren.pt"
    run = write_chain(tmp_path / "run")
    assert export_run(run, out, "torchscript").noise is not None
    assert export_run(run, out, "torchscript", inverse=True, force=True).noise is None
    assert sorted(path.name for path in out.parent.iterdir()) == ["ren.card.md", "ren.pt"]


def test_nothing_is_left_of_an_export_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write_chain(tmp_path / "run")
    monkeypatch.setattr(exports, "TOLERANCE", -1.0)
    with pytest.raises(CpunetError, match="differs from the run"):
        export_run(run, tmp_path / "out" / "ren.pt", "torchscript")
    assert list((tmp_path / "out").iterdir()) == []


def test_parts_of_a_report_that_are_no_scores_are_left_out() -> None:
    peaks = {
        "DEP": 3,
        "SEP": {"parameters": 3},
        "FEP": {"parameters": {"tail_slope": {"iou": {"ren": 80.04, "raw": None}}, "rise": 1}},
    }
    assert _score_table(peaks)[3:] == ["| FEP | tail slope | ren 80.0 |", ""]
