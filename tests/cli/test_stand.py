"""``cpunet stand``: a small stand, read by the package's own readers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cpunet.pulses.loading import load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.training.response_starts import GOOD_FIT
from synthetic import prepared_truth

EVENTS = "FEP=40,DEP=20"


@pytest.fixture
def made(command, tmp_path: Path) -> Path:
    out = tmp_path / "stand"
    words = ("--preset", "ornl", "--events", EVENTS, "--shift", "default", "--out", out)
    done = command("stand", *words)
    assert done.code == 0, done.err
    assert "sim.lh5" in done.out
    return out


def test_the_folder_is_read_and_prepared(made: Path):
    recipe = load_recipe("fast")
    chosen = parse_selection("FEP,DEP", recipe.peaks)
    sim = load_pulses(PulseFile(made / "sim.lh5"), "simulated", recipe, chosen)
    data = load_pulses(PulseFile(made / "data.lh5"), "measured", recipe, chosen)
    assert len(sim.prepared) > 20
    assert len(data.prepared) > 10
    truth = prepared_truth(made / "truth.npz", sim, recipe.preparation)
    assert np.isfinite(truth).all()
    # the mean edge of the truth is that of the data, within what the detector's shift makes
    measured = data.prepared.pulses.waveforms.mean(axis=0)
    assert np.abs(truth.mean(axis=0) - measured).max() < 0.1
    made_by = json.loads((made / "stand.json").read_text())
    assert made_by["shift"]["temperature_K"] == 2
    assert made_by["data"]["detector"]["temperature_K"] == 92
    with np.load(made / "data_labels.npz") as stored:
        flags = dict(stored)
    assert len(flags["label"]) == len(flags["flag"]) == made_by["counts"]["n_data"]
    assert set(flags["label"]) <= {0, 2, 3}
    left = flags["tails_kev"] > 1
    assert (left == (flags["flag"] & 1 > 0)).mean() > 0.99
    assert 0.1 < left.mean() < 0.6
    assert set(flags) == {"label", "flag", "tails_kev", "n_piled", "piled_kev", "piled_ns"}


@pytest.mark.slow
def test_no_ringing_is_invented_for_a_fast_decay(command, tmp_path: Path):
    """With 2,000 pulses a fit with fixed fast decays is poor, and a ringing imitates one."""
    stand, run = tmp_path / "stand", tmp_path / "run"
    words = (
        "stand",
        "--preset",
        "ornl",
        "--set",
        "earlier_pulses.rate_kHz=0",
        "--events",
        "FEP=2000",
        "--seed",
        3,
    )
    assert command(*words, "--out", stand).code == 0
    words = ("train", "--sim", stand / "sim.lh5", "--data", stand / "data.lh5", "--out", run)
    assert command(*words).code == 0
    fit = json.loads((run / "run.json").read_text())["fit"]
    found = fit["parameters"]
    assert "ringing_mhz" not in found
    assert found["pole_1_ns"] == pytest.approx(55, rel=0.1)
    assert found["fast_decay_1_us"] == pytest.approx(2.9, rel=0.15)
    assert found["decay_us"] == pytest.approx(54.6, rel=0.05)
    assert fit["chi_square"] < GOOD_FIT * fit["moments"]
