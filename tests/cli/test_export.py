"""The commands export and library: what they print, write and refuse."""

from __future__ import annotations

import lh5
import numpy as np
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
    short = ["--grid-mm", "12", "--set", "dt_ns=8", "--set", "length_ns=2400"]
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
