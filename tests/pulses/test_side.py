"""Simulated and measured pulses are told apart, by their file or by their look."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.provenance import apparent_side, recorded_side, require_side
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.writing import PulseWriter

TIME = np.arange(800)


def charge(n: int = 40) -> np.ndarray:
    """Charge that is collected from sample 300 on, in steps as of several sites."""
    rng = np.random.default_rng(3)
    arrival = rng.uniform(300, 400, (n, 2, 1))
    sites = 1 / (1 + np.exp(-(TIME - arrival) / rng.uniform(2, 9, (n, 2, 1))))
    return sites.mean(axis=1)


def adc(pulses: np.ndarray, noise: float = 8.0, gain: float = 30_000.0) -> np.ndarray:
    """Counts behind a decay of 50 µs, with a baseline and noise."""
    rng = np.random.default_rng(4)
    decayed = pulses * np.exp(-np.maximum(TIME - 350, 0) * 16 / 50_000)
    return np.round(9000 + gain * decayed + rng.normal(0, noise, pulses.shape))


@pytest.mark.parametrize(
    ("pulses", "side"),
    [
        (charge(), "simulated"),
        (charge().astype(np.float32), "simulated"),
        (np.round(1e4 * charge()), "simulated"),  # as siggen stores them
        (adc(charge()), "measured"),
        (adc(charge()).astype(np.float32), "measured"),
        (adc(charge(), noise=1.0), "measured"),
        (adc(charge(), gain=300.0), "measured"),  # 30 keV
        (charge() + np.random.default_rng(1).normal(0, 1e-3, (40, 800)), None),
        (adc(charge()) / 3e4, None),  # scaled: may be a simulation with noise
        (charge() * np.exp(-TIME / 3000), None),  # a simulated readout
        (charge()[:, :50], None),
        (np.full((5, 800), 3.0), None),
        (np.full((5, 800), np.nan), None),
        (np.empty((0, 800)), None),
    ],
)
def test_the_look(pulses, side):
    found = apparent_side(pulses)
    assert (None if found is None else found.side) == side
    assert found is None or not found.certain


def source_of(path, waveforms, **attrs):
    with PulseWriter(path, attrs=attrs) as writer:
        writer.append(Pulses.of(waveforms, dt_ns=16))
    return open_pulses(path)


@pytest.mark.parametrize(
    ("attrs", "side"),
    [
        ({"translated_by": "cpunet ren"}, "measured"),
        ({"translated_by": "cpunet iren"}, "simulated"),
        ({"made_by": "cpunet simulate 0.1.0"}, "simulated"),
        ({"made_by": "cpunet stand 0.1.0", "side": "simulated"}, "simulated"),
        ({"made_by": "cpunet stand 0.1.0", "side": "measured"}, "measured"),
        ({"made_by": "cpunet stand 0.1.0"}, None),  # an older stand: by its look
        ({}, None),
    ],
)
def test_what_a_file_says(tmp_path, attrs, side):
    source = source_of(tmp_path / "pulses.lh5", charge(), **attrs)
    found = recorded_side(source)
    assert (None if found is None else found.side) == side
    assert found is None or found.certain


def test_a_guess_can_be_overruled_and_a_record_cannot(tmp_path):
    looks = source_of(tmp_path / "looks.lh5", adc(charge()))
    require_side(looks, "measured", "swap them", insist=False)
    require_side(looks, "simulated", "swap them", insist=True)
    with pytest.raises(CpunetError) as refused:
        require_side(looks, "simulated", "swap them", insist=False)
    assert str(refused.value) == (
        f"{tmp_path / 'looks.lh5'}: given as simulated pulses, but these look measured (whole "
        "numbers with noise before the pulse); swap them; if they are simulated, say so with "
        "`insist`"
    )
    says = source_of(tmp_path / "says.lh5", adc(charge()), made_by="cpunet simulate 0.1.0")
    require_side(says, "simulated", "swap them", insist=False)
    with pytest.raises(CpunetError, match=r"simulated by cpunet simulate 0\.1\.0; swap them$"):
        require_side(says, "measured", "swap them", insist=True)
