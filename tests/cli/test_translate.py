"""`cpunet translate` over many files and in ADC counts."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from cpunet.networks.positional_unet import PositionalUNet


@pytest.fixture
def sources(stand, tmp_path):
    """Three files of pulses, the second with two that cannot be translated."""
    folder = tmp_path / "in"
    folder.mkdir()
    waveforms = stand.sim_waveforms[:20].copy()
    for number in range(3):
        if number == 1:
            waveforms[4], waveforms[5, 3] = 0.5, np.nan
        path = folder / f"sim_{number}.lh5"
        stand.write(path, "geds/sim", waveforms, stand.sim_kev[:20], units="")
        waveforms = stand.sim_waveforms[:20].copy()
    return folder


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def said(outcome):
    return " ".join(outcome.out.split())


def test_a_pattern_into_a_folder(command, trained, sources, tmp_path):
    out = tmp_path / "out"
    words = ("translate", trained, sources / "sim_*.lh5", "--out", f"{out}/")
    outcome = command(*words)
    assert outcome.code == 0, outcome.err
    expected = "3 files, 58 of 60 pulses translated; rows of NaN for 1 nan, 1 constant"
    assert expected in said(outcome)
    assert names(out) == names(sources)
    refused = command(*words)
    assert refused.code == 2
    assert "sim_0.lh5: exists already" in refused.err
    before = [(out / name).read_bytes() for name in names(out)]
    (out / "sim_1.lh5").unlink()
    again = command(*words, "--resume")
    assert again.code == 0
    assert "3 files, 58 of 60 pulses translated (2 files were there already)" in said(again)
    assert [(out / name).read_bytes() for name in names(out)] == before
    other = command(*words, "--resume", "--seed", 5)
    assert other.code == 2
    assert "was made with other options (seed)" in other.err.splitlines()[-1]


def test_a_file_into_a_folder_that_is_there(command, trained, sources, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    assert command("translate", trained, sources / "sim_0.lh5", "--out", out).code == 0
    assert names(out) == ["sim_0.lh5"]


def test_adc_counts(command, trained, stand, sources, tmp_path, monkeypatch):
    # at its end, as windows of data are
    monkeypatch.setattr(PositionalUNet, "forward", lambda _, pulses, **_options: 0.8 * pulses)
    first = ("translate", trained, sources / "sim_1.lh5", "--adc", "--out")
    length = ("--length", 1000, "--n-pre", 480, "--out-table", "ch1/like_data")
    # the run was trained on data of 15 ADC per keV on a baseline of 8000
    outcome = command(*first, tmp_path / "a.lh5", *length)
    assert outcome.code == 0, outcome.err
    assert "18 of 20 pulses translated; rows of 0 for 1 nan, 1 constant" in said(outcome)
    with h5py.File(tmp_path / "a.lh5") as file:
        values = file["ch1/like_data/waveform/values"]
        assert (values.dtype, values.shape) == (np.uint16, (20, 1000))
        traces = values[:].astype(float)
    assert (traces[4:6] == 0).all()
    kept = np.delete(traces, [4, 5], axis=0)
    assert (kept[:, :50] == 8000).all()
    late = kept[:, 875:880].mean(axis=1) - 8000
    expected = 15 * np.exp(-400 * 16 / 55_000) * np.delete(stand.sim_kev[:20], [4, 5])
    np.testing.assert_allclose(late, expected, rtol=0.01)
    refused = command("translate", trained, sources / "sim_0.lh5", "--out", "x", *length)
    assert refused.code == 2
    assert "add --adc" in refused.err
