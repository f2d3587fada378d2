"""Pulse-shape parameters against closed forms, dspeed's own chain, and invariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from cpunet.errors import CpunetError
from cpunet.pulses import _current_kernels, parameters
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import (
    PARAMETERS,
    current_amplitude,
    drift_time,
    pulse_parameters,
    tail_slope,
)
from cpunet.recipes import load_recipe
from synthetic import PREPARATION

DT_NS = 16.0
TIME = np.arange(800.0)

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 10})


def multi_site(n: int, noise: float, seed: int) -> np.ndarray:
    """Pulses of one to three steps anywhere on the edge, with a decay and noise."""
    rng = np.random.default_rng(seed)
    pulses = np.zeros((n, len(TIME)))
    for _ in range(3):
        centre = rng.uniform(250, 395, (n, 1))
        height = rng.uniform(0, 1, (n, 1))
        pulses += height * ndtr((TIME - centre) / rng.uniform(0.5, 12, (n, 1)))
    pulses *= np.exp(-np.clip(TIME - 400, 0, None) / 3400) / pulses.max(axis=1, keepdims=True)
    return (pulses + rng.normal(0, noise, pulses.shape)).astype(np.float32)


def production_chain(waveforms: np.ndarray) -> np.ndarray:
    """I_max from a processing chain as the experiments configure it."""
    from dspeed import build_processing_chain
    from lgdo import Table, WaveformTable

    table = Table(size=len(waveforms))
    table.add_field("waveform", WaveformTable(values=waveforms, dt=16, dt_units="ns", t0=0))
    steps = {
        "curr": ("avg_current", ["waveform", 1, "curr(len(waveform) - 1, 'f')"], "ADC"),
        "curr_up": (
            "upsampler",
            ["curr", 16, "curr_up((len(curr) - 1) * 16, 'f', period=curr.period / 16)"],
            "ADC",
        ),
        "curr_av": ("moving_window_multi", ["curr_up", 48, 3, 0, "curr_av"], "ADC"),
        "t_min, t_max, a_min, a_max": (
            "min_max",
            ["curr_av", "t_min", "t_max", "a_min", "a_max"],
            ["ns", "ns", "ADC", "ADC"],
        ),
    }
    processors = {
        name: {"function": function, "module": "dspeed.processors", "args": args, "unit": unit}
        for name, (function, args, unit) in steps.items()
    }
    chain, _, out = build_processing_chain(
        {"outputs": ["a_max"], "processors": processors}, table
    )
    chain.execute()
    return out["a_max"].nda


@pytest.mark.parametrize("noise", [0.0, 7.5e-4, 0.05])
def test_current_amplitude_equals_the_production_chain(noise):
    waveforms = multi_site(400, noise, seed=1)
    expected = production_chain(waveforms)
    assert np.abs(current_amplitude(waveforms) - expected).max() < 1e-6


@pytest.mark.parametrize("length", [6, 50, 97, 98, 150])
def test_current_amplitude_of_short_records_equals_the_production_chain(length):
    waveforms = multi_site(50, 0.01, seed=2)[:, 300 : 300 + length]
    assert current_amplitude(waveforms) == pytest.approx(production_chain(waveforms), abs=1e-6)


@pytest.mark.parametrize("n", [1, 40])
def test_averages_of_several_pulses_are_those_of_dspeed_to_the_last_bit(n):
    from dspeed.processors import avg_current, moving_window_multi, upsampler

    waveforms = multi_site(n, 0.01, seed=4)
    waveforms[0, 120] = np.nan
    expected = np.empty((n, waveforms.shape[1] - 1), np.float32)
    avg_current(waveforms, 1, expected)
    fine = np.empty((n, (expected.shape[1] - 1) * 16), np.float32)
    upsampler(expected, 16, fine)
    smooth = np.empty_like(fine)
    moving_window_multi(fine, 48, 3, 0, smooth)
    current, steepest = _current_kernels.currents(waveforms)
    np.testing.assert_array_equal(current, expected)
    np.testing.assert_array_equal(steepest[1:], expected.argmax(axis=1)[1:])
    found = _current_kernels.averaged_maxima(
        current,
        np.zeros(n, np.int64),
        current.shape[1],
        upsampling=16,
        steps=48,
        averages=3,
        ends=5,
    )
    np.testing.assert_array_equal(found, smooth[:, 5:-5].max(axis=1))


def test_current_amplitude_finds_a_maximum_far_from_the_steepest_sample():
    # a lone spike of one sample is averaged away, a broad ramp elsewhere is not
    pulse = np.clip((TIME - 600) / 20, 0, 1)
    pulse[100] += 0.08
    assert current_amplitude(pulse[np.newaxis].astype(np.float32)) == pytest.approx(0.05, 1e-4)


@pytest.mark.parametrize("sigma", [6.0, 10.0, 20.0])
def test_current_amplitude_of_a_gaussian_current(sigma):
    pulse = ndtr((TIME - 380.5) / sigma)[np.newaxis].astype(np.float32)
    # variances add: differences and steps of one sample, and three averages over three
    width = np.sqrt(sigma**2 + (1 + 1 + 3 * 9) / 12)
    assert current_amplitude(pulse) == pytest.approx(1 / (np.sqrt(2 * np.pi) * width), rel=2e-3)


def test_current_amplitude_does_not_depend_on_blocks(monkeypatch):
    waveforms = multi_site(20, 1e-3, seed=3)
    whole = current_amplitude(waveforms)
    monkeypatch.setattr(parameters, "BLOCK", 3)
    np.testing.assert_array_equal(current_amplitude(waveforms), whole)


@given(
    start=st.floats(100, 250),
    samples=st.floats(20, 140),
    height=st.floats(0.01, 1e4),
    fraction=st.floats(0.005, 0.5),
)
@example(start=100.00000000000001, samples=20.0, height=1.0, fraction=0.5)
@settings(max_examples=50, deadline=None)
def test_drift_time_of_a_ramp(start, samples, height, fraction):
    ramp = (height * np.clip((TIME - start) / samples, 0, 1)).astype(np.float32)
    measured = drift_time(ramp[np.newaxis], DT_NS, fraction)
    first_top = np.argmax(ramp)  # by a rounding it may be the sample before the corner's
    expected = (first_top - (start + fraction * samples)) * DT_NS
    # the ramp's corner lies between samples, where straight lines miss it a little
    assert measured == pytest.approx(expected, abs=0.5 * DT_NS)


def test_drift_time_is_interpolated_between_samples():
    crossings = np.linspace(200, 201, 11)[:, np.newaxis]
    ramps = np.clip((TIME - crossings) / 100, 0, 1)
    ramps[:, 400:] = 1.5  # so that every pulse has the same first maximum
    measured = drift_time(ramps.astype(np.float32), DT_NS, 0.2)
    assert measured == pytest.approx((400 - crossings[:, 0] - 30) * DT_NS, abs=1e-2)


def test_drift_time_ignores_what_precedes_the_last_crossing_and_follows_the_maximum():
    ramp = np.clip((TIME - 300) / 50, 0, 1)
    expected = drift_time(ramp[np.newaxis].astype(np.float32), DT_NS, 0.01)
    ramp[100:110] = 0.5
    ramp[500:] = 0.0
    assert drift_time(ramp[np.newaxis].astype(np.float32), DT_NS, 0.01) == expected


@given(tau_us=st.floats(10, 1000), height=st.floats(0.1, 1e4))
@settings(max_examples=50, deadline=None)
def test_tail_slope_gives_the_decay_constant(tau_us, height):
    decay = height * np.exp(-TIME * DT_NS * 1e-3 / tau_us)
    slope = tail_slope(decay[np.newaxis].astype(np.float32), DT_NS, 300)
    assert slope == pytest.approx(-1e3 / tau_us, rel=1e-4)


def test_tail_slope_equals_a_polynomial_fit():
    waveforms = multi_site(20, 1e-3, seed=4)
    time_ms = np.arange(300) * DT_NS * 1e-6
    expected = np.polyfit(time_ms, np.log(waveforms[:, -300:].astype(float)).T, 1)[0]
    assert tail_slope(waveforms, DT_NS, 300) == pytest.approx(expected, rel=1e-9)


def test_flat_tail_has_slope_zero():
    slope = tail_slope(np.ones((2, 800), np.float32), DT_NS, 300)
    assert slope.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("bad", [0.0, -0.1, np.nan, np.inf])
def test_a_tail_without_logarithm_gives_nan_for_that_pulse_only(bad):
    waveforms = np.ones((3, 800), np.float32)
    waveforms[1, 600] = bad
    assert np.isnan(tail_slope(waveforms, DT_NS, 300)).tolist() == [False, True, False]


def test_a_pulse_with_nan_gives_nan_for_that_pulse_only():
    waveforms = multi_site(5, 1e-3, seed=5)
    waveforms[2, 700] = np.nan
    found = pulse_parameters(Pulses.of(waveforms, dt_ns=DT_NS), PREPARATION, SCORES)
    assert found.keys() == PARAMETERS.keys()
    for values in found.values():
        assert np.isnan(values).tolist() == [False, False, True, False, False]


def test_a_constant_pulse_has_no_drift_time_and_no_current():
    flat = np.full((1, 800), 0.5, np.float32)
    assert np.isnan(drift_time(flat, DT_NS, 0.01)).all()
    assert current_amplitude(flat).tolist() == [0.0]


def test_no_pulses_give_no_values():
    found = pulse_parameters(Pulses.of(np.zeros((0, 800)), dt_ns=DT_NS), PREPARATION, SCORES)
    assert {name: values.shape for name, values in found.items()} == dict.fromkeys(
        PARAMETERS, (0,)
    )


def test_records_too_short_are_refused_in_one_line():
    short = np.zeros((2, 5), np.float32)
    for call in (
        lambda: current_amplitude(short),
        lambda: tail_slope(short, DT_NS, 300),
        lambda: drift_time(short[:, :1], DT_NS, 0.01),
    ):
        with pytest.raises(CpunetError, match=r"waveforms have shape \(2, \d\); .* or more$"):
            call()


def test_axis_labels_name_the_unit():
    assert PARAMETERS["drift_time"].axis_label == "Drift time, 1 % to maximum [ns]"


def test_current_amplitude_of_measured_traces_equals_the_production_chain(reference_data):
    import h5py

    with h5py.File(reference_data / "closure" / "data.lh5") as file:
        traces = file["geds/raw/waveform/values"][:300].astype(np.float32)
    traces -= traces[:, :200].mean(axis=1, keepdims=True)
    traces /= traces.max(axis=1, keepdims=True)
    assert np.abs(current_amplitude(traces) - production_chain(traces)).max() < 1e-6
