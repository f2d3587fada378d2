"""The commands export and library: what they print, write and refuse."""

from __future__ import annotations

import lh5
import numpy as np
import pytest
import torch
from lgdo import Array, Scalar, Struct


def library_file(path):
    time = np.arange(1500.0)
    charge = 1 / (1 + np.exp(-(time - np.linspace(500, 900, 12)[:, None]) / 40))
    charge = charge.reshape(3, 4, 1500)
    charge[2, 3] = np.nan
    content = {
        "r": Array(np.arange(3.0), attrs={"units": "mm"}),
        "z": Array(np.arange(4.0), attrs={"units": "mm"}),
        "dt": Scalar(1.0, attrs={"units": "ns"}),
        "t0": Scalar(0.0, attrs={"units": "ns"}),
        "waveform_000_deg": Array(charge, attrs={"units": ""}),
    }
    lh5.write(Struct(content), "V01", str(path), wo_mode="of")
    return path


def test_a_library_is_made(command, tmp_path):
    words = ["library", "make", "--detector", "ppc", "--out", tmp_path / "psl.lh5"]
    short = ["--grid-mm", "12", "--dt-ns", "8", "--length-ns", "2400"]
    done = command(*words, *short, "--angles", "0,30,45")
    assert done.code == 0, done.err
    assert "places have a template" in done.out
    (name,) = lh5.ls(str(tmp_path / "psl.lh5"))
    made = lh5.read(name, str(tmp_path / "psl.lh5"))
    assert {"waveform_000_deg", "waveform_030_deg", "drift_time_045_deg"} <= set(made)
    assert made["dt"].value == 8
    assert made["waveform_000_deg"].nda.shape[2] == 300
    for wrong in (["--angles", "0,0"], ["--angles", "1.5"], ["--grid-mm", "0"]):
        refused = command(*words[:-1], tmp_path / "other.lh5", *short, *wrong)
        assert refused.code == 2
        assert "Traceback" not in refused.err
        assert not (tmp_path / "other.lh5").exists()


@pytest.mark.slow
def test_export(command, trained, tmp_path):
    out = tmp_path / "ren.onnx"
    done = command("export", "onnx", trained, "--out", out)
    assert done.code == 0, done.err
    assert "of the run" in done.out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ren.card.md", "ren.onnx"]
    card = (tmp_path / "ren.card.md").read_text()
    assert "recipe paper" in card
    assert "`epsilon`" in card
    assert "data.lh5" in card


def test_import_weights(command, tmp_path):
    refused = command("import", "--out", tmp_path / "run")
    assert refused.code == 2
    assert "no generator given; name fep_REN.pt (--ren), fep_IREN.pt (--iren)" in refused.err
    torch.save({"weight": torch.zeros(1)}, tmp_path / "other.pt")
    refused = command("import", "--ren", tmp_path / "other.pt", "--out", tmp_path / "run")
    assert refused.code == 2
    assert "no Positional U-Net" in refused.err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["library", "translate", "RUN", "FINE"], "give a run of the recipe fast"),
        (["export", "legend", "RUN"], "no response in closed form"),
    ],
)
def test_what_production_cannot_use_is_refused(command, trained, tmp_path, words, told):
    fine = library_file(tmp_path / "fine.lh5")
    names = {"RUN": trained, "FINE": fine}
    refused = command(*(names.get(word, word) for word in words), "--out", tmp_path / "out")
    assert refused.code == 2
    assert told in " ".join(refused.err.split())
    assert len(refused.err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
