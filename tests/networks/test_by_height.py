"""Follower and curve against recursions written down, and pulses that pass them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cpunet.electronics.finishing import finish
from cpunet.errors import CpunetError
from cpunet.networks.by_height import LAG_KNOTS, PER_STEP, ByHeight
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.files import open_pulses
from cpunet.translation.options import Adc
from cpunet.translation.translate import translate
from cpunet.translation.translator import REN
from synthetic import edges, load_recipe, write_chain, write_pulses

KEV, LIMIT = 2000.0, 60.0


def slewing() -> ByHeight:
    """An amplifier whose output rises by not much more than `LIMIT` keV per sample."""
    circuit = ByHeight()
    circuit.step_kev[...], circuit.top_kev[...] = 100.0, 1.02 * KEV
    step = 100.0 * np.arange(1, LAG_KNOTS) / PER_STEP / LIMIT
    circuit.lag[1:] = -np.log(np.tanh(step) / step)
    return circuit


def test_a_follower_is_its_recursion() -> None:
    records = edges(5, seed=1).astype(np.float64)
    expected = KEV * records
    for i in range(1, records.shape[1]):
        d = expected[:, i] - expected[:, i - 1]
        expected[:, i] = expected[:, i - 1] + LIMIT * np.tanh(d / LIMIT)
    found = slewing()(records, np.full(5, KEV)) * KEV
    np.testing.assert_allclose(found, expected, atol=1.0)
    assert np.diff(found, axis=1).max() < LIMIT < np.diff(KEV * records, axis=1).max()


def curved() -> ByHeight:
    """A curve whose slope at a height of 0 is 10 %."""
    circuit = ByHeight()
    circuit.top_kev[...] = KEV
    place = np.linspace(0, 1, len(circuit.curve))
    circuit.curve[:] = 0.1 * place * (1 - place)
    return circuit


def test_a_curve_adds_what_the_height_says() -> None:
    """Below zero, a line goes on."""
    records = np.linspace(-0.1, 1.1, 50)[np.newaxis]
    slope = np.where(records < 0, 1, 1 - records.clip(0, 1))
    expected = records + 0.1 * records * slope
    np.testing.assert_allclose(curved()(records, np.array([KEV])), expected, atol=1e-4)


def test_noise_of_baselines_has_passed_the_curve() -> None:
    """So it is the same behind it at a height of zero, and less where the curve is flat."""
    noise = 1e-3 * np.random.default_rng(1).normal(size=(4, 5000))
    for height, slope in ((0.0, 1.0), (0.5, 1 / 1.1)):
        records = np.full(noise.shape, height)
        behind = curved()(records, np.full(4, KEV), noise)
        assert behind.std() == pytest.approx(slope * noise.std(), rel=0.01)


def test_noise_passes_the_amplifier_with_the_pulse() -> None:
    config, pulses = load_recipe("fast").at(16.0).preparation, edges(4, seed=3)
    kev = np.full(4, KEV)
    records = np.pad(pulses, ((0, 0), (200, 400)), mode="edge")
    found = finish(records, config, dt_ns=16.0, energy_kev=kev, by_height=slewing())
    alone = finish(slewing()(records, kev), config, dt_ns=16.0)
    np.testing.assert_array_equal(found.windows, alone.windows)


def test_a_run_stores_what_acts_by_height_and_raw_traces_have_it(tmp_path: Path) -> None:
    """The largest step of a high pulse is limited, that of a low one is not."""
    fill = lambda chain: chain.response.by_height.fill(slewing().arrays())  # noqa: E731
    run = write_chain(tmp_path / "run", "generator.by_height=true", change=fill)
    ren, charge = REN.load(run), edges(4, seed=4)
    with pytest.raises(CpunetError, match="energy_kev"):
        ren.translate(charge, noise=False)
    low, high = (ren.translate(charge, energy_kev=kev, noise=False) for kev in (200.0, KEV))
    assert np.abs(np.diff(low)).max() > 1.05 * np.abs(np.diff(high)).max()
    source, out, kev = tmp_path / "sim.lh5", tmp_path / "out.lh5", np.repeat([200.0, KEV], 4)
    write_pulses(source, Pulses.of(np.tile(charge, (2, 1)), dt_ns=16.0, energy_kev=kev))
    scale = Adc(adc_per_kev=8.0, baseline=1000.0)
    translate(run, source, out, adc=True, scale=scale, noise=False)
    traces = open_pulses(out).read().waveforms.astype(float)
    low, high = np.diff(traces, axis=1).max(axis=1).reshape(2, 4)
    assert high.max() < 8 * 1.1 * LIMIT
    assert (low / 200.0 > 1.05 * high / KEV).all()
