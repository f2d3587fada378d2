"""Parameters of pulses, and their alignment at half maximum, against analytic pulses."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import (
    PARAMETERS,
    align_half_maximum,
    current_amplitude,
    drift_time,
    pulse_parameters,
    tail_slope,
)
from cpunet.pulses.shape_parameters import (
    SHAPE_PARAMETERS,
    TIME_POINTS,
    all_parameters,
    median_decay_ns,
)
from synthetic import PREPARATION, load_recipe
from synthetic import gaussian_edge as edge

DT_NS = 16.0
TIME = np.arange(800.0)

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 10})


def multi_site(n: int, noise: float, seed: int) -> np.ndarray:
    """Pulses of one to three steps anywhere on the edge, with a decay and noise."""
    rng = np.random.default_rng(seed)
    pulses = np.zeros((n, len(TIME)))
    for _ in range(3):
        centre, height = rng.uniform(250, 395, (n, 1)), rng.uniform(0, 1, (n, 1))
        pulses += height * ndtr((TIME - centre) / rng.uniform(0.5, 12, (n, 1)))
    pulses *= np.exp(-np.clip(TIME - 400, 0, None) / 3400) / pulses.max(axis=1, keepdims=True)
    return (pulses + rng.normal(0, noise, pulses.shape)).astype(np.float32)


def production_chain(waveforms: np.ndarray) -> np.ndarray:
    """I_max by the processors of the experiments, as they configure them."""
    from dspeed.processors import avg_current, moving_window_multi, upsampler

    n, length = waveforms.shape
    current, fine = np.empty((n, length - 1), "f4"), np.empty((n, 16 * (length - 2)), "f4")
    avg_current(waveforms, 1, current)
    upsampler(current, 16, fine)
    smooth = np.empty_like(fine)
    moving_window_multi(fine, 48, 3, 0, smooth)
    return smooth.max(axis=1)


# in more noise the chain's maximum can be a sample at an end of the record, which it holds
@pytest.mark.parametrize("noise", [0.0, 7.5e-4, 0.01])
def test_current_amplitude_equals_the_production_chain(noise):
    waveforms = multi_site(400, noise, seed=1)
    expected = production_chain(waveforms)
    assert np.abs(current_amplitude(waveforms, 16.0) - expected).max() < 1e-6


def test_current_amplitude_finds_a_maximum_far_from_the_steepest_sample():
    # a lone spike of one sample is averaged away, a broad ramp elsewhere is not
    pulse = np.float32(np.clip((TIME - 600) / 20, 0, 1) + 0.08 * (TIME == 100))
    assert current_amplitude(pulse[np.newaxis], 16.0) == pytest.approx(0.05, 1e-4)


def sampled(decay_ns: float, dt_ns: float, means: bool) -> np.ndarray:
    """Step responses of two poles at phases of the clock, at times or as means of periods."""
    start = 4000 + np.linspace(0, 1, 16, endpoint=False)[:, np.newaxis] * dt_ns

    def since(time: np.ndarray) -> np.ndarray:
        return np.clip(time - start, 0, None) / decay_ns

    time = np.arange(8000 / dt_ns) * dt_ns
    if not means:
        return (1 - np.exp(-since(time)) * (1 + since(time))).astype(np.float32)
    ends = since(np.append(time, 8000.0) - dt_ns / 2)
    integral = ends - 2 + (ends + 2) * np.exp(-ends)
    return (np.diff(integral) * decay_ns / dt_ns).astype(np.float32)


@pytest.mark.parametrize("dt_ns", [1.0, 2.0, 4.0, 8.0, 10.0])
@pytest.mark.parametrize("means", [False, True])
@pytest.mark.parametrize("decay_ns", [20.0, 50.0, 150.0])
def test_the_current_amplitude_per_ns_is_the_same_at_any_period(decay_ns, means, dt_ns):
    per_ns, wanted = (
        np.median(current_amplitude(sampled(decay_ns, dt, means), dt)) / dt
        for dt in (dt_ns, DT_NS)
    )
    assert per_ns == pytest.approx(wanted, rel=6e-3)


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


def test_tail_slope_equals_a_polynomial_fit():
    waveforms = multi_site(20, 1e-3, seed=4)
    time_ms = np.arange(300) * DT_NS * 1e-6
    expected = np.polyfit(time_ms, np.log(waveforms[:, -300:].astype(float)).T, 1)[0]
    assert tail_slope(waveforms, DT_NS, 300) == pytest.approx(expected, rel=1e-9)


def parameters_of(waveforms: np.ndarray, **how: float) -> dict[str, np.ndarray]:
    pulses = Pulses.of(np.atleast_2d(waveforms), dt_ns=DT_NS)
    return all_parameters(pulses, PREPARATION, SCORES, **how)


@pytest.mark.parametrize("samples", [30, 97, 200])
def test_times_and_areas_of_a_ramp(samples):
    found = parameters_of(np.clip((TIME - 400 + samples) / samples, 0, 1))
    shares = {name: fraction - 1 for name, fraction in TIME_POINTS.items()}
    rises = ((10, 90), (1, 90), (1, 99), (10, 99), (90, 99))
    shares |= {f"rise_{low:02}_{high}": (high - low) / 100 for low, high in rises}
    for name, share in (shares | {"drift_time": 0.99}).items():
        assert found[name] == pytest.approx(share * samples * DT_NS, abs=0.01)


@pytest.mark.parametrize("decay_us", [np.inf, 60.0])
@pytest.mark.parametrize("samples", [40, 97])
def test_quantities_of_legend_of_a_ramp_that_decays(samples, decay_us):
    """Without the decay it is a ramp: triangles over it, and shares of it, are known."""
    ramp, rise_ns = np.clip((TIME - 400 + samples) / samples, 0, 1), samples * DT_NS
    kept = np.exp(-DT_NS / (1e3 * decay_us))
    pulse = scipy.signal.lfilter([1, -1], [1, -kept], ramp)
    found = parameters_of(pulse)
    for percent in (50, 90, 99):
        wanted = (percent / 100 - 1) * rise_ns
        assert found[f"tp_{percent}"] == pytest.approx(wanted, abs=0.02 * rise_ns)
    assert found["rise_time"] == pytest.approx(0.8 * rise_ns, rel=0.01)
    assert found["tp_0_est"] == pytest.approx(-rise_ns, abs=3 * DT_NS)
    # the filter finds the begin somewhat late
    assert found["dt_eff"] == pytest.approx(rise_ns / 2, abs=2 * DT_NS)
    # dspeed sums samples, not trapezoids: half a sample of the height missing at the begin
    missing = 0.2**2 / 2 * rise_ns - 0.1 * DT_NS
    assert found["lq"] == pytest.approx(missing, rel=0.02)


def test_baseline_rms_is_that_about_a_line():
    waveforms = multi_site(20, 3e-3, seed=6) + np.float32(1e-4) * TIME.astype(np.float32)
    squares = np.polyfit(TIME[:200], waveforms[:, :200].T.astype(float), 1, full=True)[1]
    rms = parameters_of(waveforms)["baseline_rms"]
    assert rms == pytest.approx(np.sqrt(squares / 198), rel=1e-6)


def test_the_three_parameters_of_the_paper_are_among_them():
    waveforms = multi_site(20, 1e-3, seed=7)
    found = parameters_of(waveforms)
    assert list(found) == list(SHAPE_PARAMETERS)
    expected = pulse_parameters(Pulses.of(waveforms, dt_ns=DT_NS), PREPARATION, SCORES)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)
        assert SHAPE_PARAMETERS[name].axis_label == PARAMETERS[name].axis_label
    for values in found.values():
        assert (values.dtype, values.shape) == (np.float64, (20,))
        assert np.isfinite(values).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("sample", [0, 390, 799])
def test_a_value_that_is_not_finite_gives_nan_for_that_pulse_only(bad, sample):
    waveforms = multi_site(5, 1e-3, seed=9)
    expected = parameters_of(waveforms)
    waveforms[2, sample] = bad
    decay_ns = median_decay_ns(expected["tail_slope"])
    for name, values in parameters_of(waveforms, decay_ns=decay_ns).items():
        assert np.isnan(values).tolist() == [False, False, True, False, False], name
        others = [0, 1, 3, 4]
        # the current amplitude is of single precision, and its products round by their rows
        rel = 1e-6 if name == "current_amplitude" else 1e-9
        assert values[others] == pytest.approx(expected[name][others], rel=rel, abs=1e-9), name


def test_the_documented_table_is_the_registry():
    page = Path(__file__).parents[2] / "docs" / "parameters.md"
    rows = [line for line in page.read_text().splitlines() if line.startswith("| `")]
    names, units, *words = zip(*(map(str.strip, r.split("|")[1:-1]) for r in rows), strict=True)
    assert names == tuple(f"`{name}`" for name in SHAPE_PARAMETERS)
    assert units == tuple(parameter.unit for parameter in SHAPE_PARAMETERS.values())
    assert all(all(column) for column in words)


def uneven(time: np.ndarray) -> np.ndarray:
    """Half of its maximum is where the edge is curved: a straight line would miss it."""
    return 0.7 * ndtr((time + HALF) / 3) + 0.3 * ndtr((time + HALF - 12) / 5)


HALF, FINE = 0.0, np.linspace(-20, 20, 400_001)
HALF = float(np.interp(0.5, uneven(FINE), FINE))
# 40 ns is the fastest real readout
EDGES = [uneven, *(partial(edge, sigma=sigma) for sigma in (2.5, 4.0, 10.0))]


@pytest.mark.parametrize("pulse", EDGES)
def test_alignment_reproduces_the_analytic_pulse_at_any_phase(pulse):
    centres = 350 + np.linspace(0, 1, 101)[:, np.newaxis]
    aligned = align_half_maximum(pulse(TIME - centres).astype(np.float32), 100, 150)
    assert np.abs(aligned - pulse(np.arange(-100.0, 150.0))).max() < 1e-4


def test_the_last_crossing_before_the_maximum_counts():
    pulse = edge(TIME - 350, 4.0)
    pulse += np.where(np.abs(TIME - 200) < 20, 0.7, 0.0)  # an earlier pulse
    pulse[500:] = 0.0  # and nothing after the maximum matters
    aligned = align_half_maximum(pulse[np.newaxis].astype(np.float32), 50, 50)
    assert aligned[0] == pytest.approx(edge(np.arange(-50.0, 50.0), 4.0), abs=1e-4)


def test_outside_the_record_there_is_no_value():
    aligned = align_half_maximum(edge(TIME[:60] - 20.25, 2.5)[np.newaxis], 30, 50)[0]
    # the crossing at 20.25 has 20 samples before it, and 38 after it, in the record
    assert np.flatnonzero(np.isfinite(aligned)).tolist() == list(range(10, 69))


NAN = np.where(TIME == 700, np.nan, edge(TIME - 350, 4.0))


@pytest.mark.parametrize("row", [np.zeros(800), np.ones(800), -edge(TIME - 300, 4.0), NAN])
def test_a_pulse_without_a_crossing_is_nan_and_its_neighbours_are_not(row):
    good = edge(TIME - 350, 4.0)
    aligned = align_half_maximum(np.stack([good, row, good]).astype(np.float32), 50, 50)
    assert np.isnan(aligned).all(axis=1).tolist() == [False, True, False]
    assert np.isfinite(aligned[[0, 2]]).all()
