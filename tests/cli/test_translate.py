"""`cpunet translate` over many files and in ADC counts."""

from __future__ import annotations

import numpy as np
import pytest


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
