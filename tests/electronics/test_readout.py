"""Chains and raw traces against integrals, circuits written out by hand, and what is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from cpunet.electronics.chain import (
    Electronics,
    Exponentials,
    NoiseSpectrum,
    moved_apart,
    read_electronics,
)
from cpunet.electronics.drawn_pile_up import TailsLaw
from cpunet.electronics.finishing import record_length, with_room
from cpunet.electronics.readout import (
    by_height,
    coloured_noise,
    linear_response,
    noise_power,
    read_out,
)
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from synthetic import PADDING_BEFORE, load_recipe, mean_kev, one_line

PRESETS = ("legend200", "ornl", "ringing", "mjd")
T_NS = np.arange(0, 20_000, 0.5)
CONFIG = load_recipe("paper").preparation
DT_NS, DECAY_NS = 16.0, 54_600.0
QUIET = {"rms_kev": 0.0, "spectrum": read_electronics("ornl").noise.spectrum}


def altered(name: str = "legend200", **values: object) -> Electronics:
    return read_electronics(name, values)


def rise_ns(step: np.ndarray) -> float:
    top = step.max()
    return float(T_NS[(step >= 0.9 * top).argmax()] - T_NS[(step >= 0.1 * top).argmax()])


@given(
    st.lists(st.sampled_from([15.0, 40.0, 40.02, 100.0]), min_size=1, max_size=4),
    st.floats(0.01, 0.2),
)
def test_step_is_that_of_the_rational_transfer_function(taus: list[float], fraction: float):
    chain = Exponentials.low_pass(500.0, fraction)
    numerator, denominator = np.array([(1 - fraction) * 500, 1.0]), np.array([500.0, 1.0])
    for tau, apart in zip(taus, moved_apart(taus), strict=True):
        chain = chain * Exponentials.low_pass(apart)
        denominator = np.polymul(denominator, [tau, 1.0])
    t = np.linspace(0, 3000, 301)
    _, expected = signal.step((numerator, denominator), T=t)
    assert np.abs(chain.step(t) - expected).max() < 1e-4


@given(st.lists(st.integers(0, 12), min_size=1, max_size=8))
def test_times_stay_in_order_and_far_enough_apart_for_residues(steps: list[int]):
    taus = 40 * (1 + 5e-4 * np.array(steps))
    moved = np.array(moved_apart(taus.tolist()))
    assert (np.diff(np.sort(moved)) > 0.9e-3 * 40).all()
    assert (np.diff(moved[np.argsort(taus, kind="stable")]) > 0).all()
    assert np.abs(moved - taus).max() < 5e-3 * 40


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("per_sample", [2, 4, 5, 16])
def test_sampled_steps_equal_the_analytic_ones(name: str, per_sample: int):
    chain, shift_ns = read_electronics(name), np.array([0.0, 5.3, -20.7, 31.9])
    fine_ns = chain.dt_ns / per_sample
    steps = Pulses.of(np.ones((4, int(3600 / fine_ns))), dt_ns=fine_ns)
    traces = linear_response(steps, chain, shift_ns)
    inner = ((np.arange(chain.length * 64) + 0.5) / 64 - chain.n_pre) * chain.dt_ns
    for trace, shift in zip(traces, shift_ns, strict=True):
        means = chain.transfer.step(inner - shift).reshape(chain.length, 64).mean(axis=1)
        assert np.abs(trace - means).max() < 1e-4


def test_presets_rise_and_decay_as_measured():
    assert 146 <= rise_ns(read_electronics("legend200").transfer.step(T_NS)) <= 172
    chain = read_electronics("ornl")
    late = chain.transfer.step([40e3, 60e3])
    assert -20 / np.log(late[1] / late[0]) == pytest.approx(54.6, rel=0.01)
    step = chain.transfer.step(T_NS)
    # prepared pulses end at 0.80, some 6.4 us after their top
    after = step[step.argmax() + round(6400 / 0.5)] / step.max()
    assert 0.93 <= 0.80 / after <= 0.97


@pytest.mark.parametrize(
    "values",
    [
        {"decays": [{"fraction": 0.9, "tau_us": 50}]},
        {"before_ns": 5},
        {"record_ns": 1e9},
        {"baseline_mean_adc": 70000},
        {"noise": {"rms_kev": 1}},
        {"colour": "blue"},
        {"trigger_jitter_ns": 1e12},  # would be followed for ages
    ],
)
def test_impossible_chains_name_the_field(tmp_path: Path, values: dict):
    path = tmp_path / "chain.yaml"
    path.write_text(yaml.safe_dump(read_electronics("ornl").model_dump(mode="json") | values))
    one_line(lambda: read_electronics(path), *values, str(path))


@pytest.mark.parametrize("late", [-3, 0, 5])
def test_windows_go_on_with_their_decay_wherever_their_maximum_is(late: int) -> None:
    """A network does not place the maximum of its output exactly."""
    start = PADDING_BEFORE + CONFIG.samples_before + late
    time = np.arange(record_length(CONFIG.length, DT_NS)) - start
    pulse = np.clip(1 + time / 40, 0, 1) * np.exp(-np.maximum(time, 0) * DT_NS / DECAY_NS)
    window = pulse[np.newaxis, PADDING_BEFORE : PADDING_BEFORE + CONFIG.length]
    record = with_room(window.astype(np.float32), CONFIG, DT_NS)
    np.testing.assert_allclose(record[0], pulse, atol=1e-5)
    # without a decay at the last level
    windows = np.ones((2, CONFIG.length), np.float32)
    windows[0, -20] = -1.0
    windows[1, 3] = np.nan
    records = with_room(windows, CONFIG, DT_NS)
    assert (records[0, -300:] == 1).all()
    assert np.isnan(records[1]).all()


def rates(rate_kHz: float = 0.0, pile_up_kHz: float = 0.0) -> dict[str, object]:
    """Rates of other pulses."""
    return {"earlier_pulses": {"rate_kHz": rate_kHz}, "pile_up": {"rate_kHz": pile_up_kHz}}


@pytest.mark.parametrize("dt_ns", [10, 16])
def test_noise_has_the_spectrum_asked_for(dt_ns: float):
    line = {"frequency_MHz": 10, "power_fraction": 0.1}
    spectrum = NoiseSpectrum(
        corner_MHz=8.5, order=3, excess=10, excess_corner_kHz=30, lines=(line,)
    )
    noise = coloured_noise(spectrum, 1000, 8192, dt_ns, np.random.default_rng(2))
    assert noise.std() == pytest.approx(1, rel=0.01)
    measured = (np.abs(np.fft.rfft(noise)) ** 2).mean(axis=0)
    measured[1:-1] *= 2  # negative frequencies
    expected = noise_power(spectrum, dt_ns, 8192)
    edges = np.unique(np.geomspace(1, 4096, 30).astype(int))
    shares = (np.add.reduceat(of, edges) for of in (measured / measured[1:].sum(), expected))
    assert np.abs(np.divide(*shares) - 1).max() < 0.05


def test_tails_follow_the_law_and_all_decays_of_the_chain():
    """Behind baseline, gain and response, of pulses of any energy, nothing else is left."""
    rng = np.random.default_rng(1)
    chain = altered("ornl", record_ns=19_200, noise=QUIET, **rates(3))
    ramps = np.clip(np.arange(900) / rng.uniform(40, 120, (4000, 1)), 0, 1)
    pulses = Pulses.of(ramps, dt_ns=4, energy_kev=rng.uniform(500, 1500, 4000))
    traces = read_out(pulses, chain, 3)
    own = traces.true_energy_kev[:, None] * traces.response
    added_kev = (traces.waveforms - traces.baseline_adc[:, None]) / chain.gain_adc_per_kev - own
    tails_kev = traces.disturbed["tails_kev"]
    without = tails_kev == 0
    assert np.abs(added_kev[without]).max() <= 0.51 / chain.gain_adc_per_kev
    assert not traces.disturbed["flag"][without].any()
    law = TailsLaw(3, 54.6, chain.other_pulses_kev)
    above = [5, 20, 100, 500]
    found = [(tails_kev > kev).mean() for kev in above]
    # several tails add up, and a twentieth of each charge decays early
    assert found == pytest.approx(law.share_above(above), rel=0.12, abs=0.01)
    assert tails_kev.mean() == pytest.approx(0.953 * mean_kev(law), rel=0.1)
    old = added_kev[tails_kev > 100]
    ratio = np.median(old[:, 1000] / old[:, 0])
    assert ratio == pytest.approx(np.exp(-16 / 54.6), rel=0.01)
    assert (old[:, 1000] / old[:, 0]).min() < 0.97 * ratio  # of pulses a few us before


def test_piled_up_pulses_are_where_the_truth_says():
    chain = altered("ornl", noise=QUIET, trigger_jitter_ns=200, **rates(0, 30))
    steps = Pulses.of(np.ones((200, 900)), dt_ns=4, energy_kev=np.full(200, 1000.0))
    traces = read_out(steps, chain, seed=2)
    n_piled, kev, after_ns = (traces.disturbed[n] for n in ("n_piled", "piled_kev", "piled_ns"))
    alone = np.flatnonzero((n_piled == 1) & (after_ns > 1000))
    assert len(alone) > 10
    adc = chain.gain_adc_per_kev
    own = adc * traces.true_energy_kev[:, None] * traces.response
    rest = (traces.waveforms - traces.baseline_adc[:, None] - own)[alone] / adc

    def rise_ns(rows: np.ndarray) -> np.ndarray:
        """Interpolated time at which the traces rise through 0.3 of their maxima."""
        level = 0.3 * rows.max(axis=1)
        after = (rows > level[:, None]).argmax(axis=1)
        low, high = (rows[np.arange(len(rows)), at] for at in (after - 1, after))
        return chain.dt_ns * (after - (high - level) / (high - low))

    assert rise_ns(rest) - rise_ns(own[alone]) == pytest.approx(after_ns[alone], abs=5)
    assert rest.max(axis=1) == pytest.approx(kev[alone], rel=0.03)
    assert np.isnan(kev[n_piled == 0]).all()


def test_what_acts_by_height_follows_its_definition():
    """A slew rate limits the steps of large signals, and a curve adds what the height says."""
    height = np.array([[50.0], [2000.0]])
    step = height * np.clip(np.arange(-10.0, 30.0) / 10, 0, 1)
    slow = by_height(step, altered(slew_kev_per_ns=5.0, nonlinearity=None))
    assert np.diff(slow[1]).max() == pytest.approx(5.0 * 16.0, rel=0.05)
    np.testing.assert_allclose(slow[0], step[0], atol=0.2)
    bent = altered(nonlinearity={"fraction": 0.002, "waves": 5})
    full = bent.adc_top / bent.gain_adc_per_kev
    added = 0.002 * full * np.sin(2 * np.pi * 5 * step / full)
    np.testing.assert_allclose(by_height(step, bent), step + added)


def test_energies_have_the_resolution_and_high_ones_are_clipped():
    energy = np.repeat([500, 2614.5], 4000)
    lines = Pulses.of(np.ones((8000, 1)), dt_ns=4, energy_kev=energy)
    short = altered(record_ns=640, before_ns=160, gain_adc_per_kev=40, **rates())
    traces = read_out(lines, short, seed=1)
    assert 2.355 * traces.energy_kev[4000:].std() == pytest.approx(2.6, rel=0.05)
    assert ((traces.disturbed["flag"] & 4 > 0) == (energy > 1000)).all()
    assert (traces.waveforms.max(axis=1) == 65535)[4000:].all()


def test_pulses_that_cannot_be_read_out_are_named():
    steps = Pulses.of(np.ones((1, 9)), dt_ns=4, event_number=[71])
    with pytest.raises(CpunetError, match="event 71"):
        read_out(steps, read_electronics("ornl"), seed=1)
    with pytest.raises(CpunetError, match="bandwidth_poles_ns means 3 ns"):
        linear_response(steps, altered(bandwidth_poles_ns=[40, 3]))
