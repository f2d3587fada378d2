"""Chains against integrals, circuits written out by hand, and the measured facts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from cpunet.electronics.chain import Electronics, electronics_names, read_electronics
from cpunet.electronics.exact_response import linear_response, respond
from cpunet.electronics.exponentials import Exponentials, moved_apart
from cpunet.electronics.finishing import PADDING_BEFORE, record_length, with_room
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.recipes import load_recipe

T_NS = np.arange(0, 20_000, 0.5)


def changed(name: str = "legend200", **values: object) -> Electronics:
    return Electronics.model_validate(read_electronics(name).model_dump() | values)


def rise_ns(step: np.ndarray) -> float:
    top = step.max()
    return float(T_NS[(step >= 0.9 * top).argmax()] - T_NS[(step >= 0.1 * top).argmax()])


@given(
    st.lists(st.sampled_from([15.0, 40.0, 40.02, 100.0]), min_size=1, max_size=4),
    st.floats(0.01, 0.2),
)
def test_step_is_that_of_the_rational_transfer_function(taus: list[float], fraction: float):
    chain = Exponentials.mixed(fraction, 500.0)
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


@pytest.mark.parametrize("name", electronics_names())
def test_impulse_is_the_derivative_of_the_step(name: str):
    chain = read_electronics(name)
    slope = np.gradient(chain.step_response(T_NS), T_NS)
    impulse = chain.impulse_response(T_NS)
    assert np.abs(slope - impulse)[1:-1].max() < 1e-4 * impulse.max() + 1e-6


@pytest.mark.parametrize("name", electronics_names())
@pytest.mark.parametrize("fine_ns", [1, 2, 4])
def test_sampled_steps_equal_the_analytic_ones(name: str, fine_ns: int):
    chain, shift_ns = read_electronics(name), np.array([0.0, 5.3, -20.7, 31.9])
    steps = Pulses.of(np.ones((4, 3600 // fine_ns)), dt_ns=fine_ns)
    traces = linear_response(steps, chain, shift_ns)
    inner = (np.arange(chain.length * 64) + 0.5) / 4 - chain.n_pre * chain.dt_ns
    for trace, shift in zip(traces, shift_ns, strict=True):
        means = chain.step_response(inner - shift).reshape(chain.length, 64).mean(axis=1)
        assert np.abs(trace - means).max() < 1e-4


def test_legend200_rises_as_measured():
    assert 146 <= rise_ns(read_electronics("legend200").step_response(T_NS)) <= 172


def test_ornl_decays_as_measured():
    chain = read_electronics("ornl")
    late = chain.step_response([40e3, 60e3])
    assert -20 / np.log(late[1] / late[0]) == pytest.approx(54.6, rel=0.01)
    step = chain.step_response(T_NS)
    # prepared pulses end at 0.80, some 6.4 us after their top
    after = step[step.argmax() + round(6400 / 0.5)] / step.max()
    assert 0.93 <= 0.80 / after <= 0.97


def test_slew_and_quadratic_bend_tall_pulses_more():
    chain = changed(non_linearity={"quadratic_fraction": 0.01, "slew_kev_per_ns": None})
    steps = Pulses.of(np.ones((2, 900)), dt_ns=4, energy_kev=[261.45, 2614.5])
    bent = respond(steps, chain).max(axis=1) / linear_response(steps, chain).max(axis=1)
    assert bent == pytest.approx([1.001, 1.01], abs=2e-4)
    slow = changed(non_linearity={"quadratic_fraction": 0.0, "slew_kev_per_ns": 2.0})
    rate = np.diff(respond(steps, slow), axis=1).max(axis=1) * steps.energy_kev / 16
    assert rate[1] == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"bandwidth_poles_ns": [-40]}, "bandwidth_poles_ns"),
        ({"slow": {"fraction": 0.1, "tau_ns": 0}}, "slow.tau_ns"),
        ({"decays": [{"fraction": 0.9, "tau_us": 50}]}, "decays"),
        ({"n_pre": 1400}, "n_pre"),
        ({"baseline_mean_adc": 70000}, "baseline_mean_adc"),
        ({"noise": {"rms_kev": 1}}, "noise"),
        ({"gain_adc_per_kev": float("inf")}, "gain_adc_per_kev"),
        ({"colour": "blue"}, "colour"),
        ({"trigger_jitter_ns": 1e12}, "trigger_jitter_ns"),  # would be followed for ages
    ],
)
def test_impossible_chains_name_the_field(tmp_path: Path, values: dict, field: str):
    path = tmp_path / "chain.yaml"
    path.write_text(yaml.safe_dump(read_electronics("ornl").model_dump(mode="json") | values))
    with pytest.raises(CpunetError, match=field) as caught:
        read_electronics(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_pole_faster_than_the_grid_names_the_field():
    steps = Pulses.of(np.ones((1, 900)), dt_ns=4, energy_kev=[1000])
    with pytest.raises(CpunetError, match="bandwidth_poles_ns means 3 ns"):
        respond(steps, changed(bandwidth_poles_ns=[40, 3]))


CONFIG = load_recipe("paper").preparation
DT_NS, DECAY_NS = 16.0, 54_600.0


@pytest.mark.parametrize("late", [-3, 0, 1, 5])
def test_windows_go_on_with_their_decay_wherever_their_maximum_is(late: int) -> None:
    """A network does not place the maximum of its output exactly."""
    time = (
        np.arange(record_length(CONFIG.length)) - PADDING_BEFORE - CONFIG.samples_before - late
    )
    pulse = np.clip(1 + time / 40, 0, 1) * np.exp(-np.maximum(time, 0) * DT_NS / DECAY_NS)
    window = pulse[np.newaxis, PADDING_BEFORE : PADDING_BEFORE + CONFIG.length]
    record = with_room(window.astype(np.float32), CONFIG, DT_NS)
    np.testing.assert_allclose(record[0], pulse, atol=1e-5)


def test_what_has_no_decay_stays_at_its_last_level() -> None:
    windows = np.ones((2, CONFIG.length), np.float32)
    windows[0, -20] = -1.0
    windows[1, 3] = np.nan
    records = with_room(windows, CONFIG, DT_NS)
    assert (records[0, -300:] == 1).all()
    assert np.isnan(records[1]).all()
