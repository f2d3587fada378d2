"""Every shape parameter against closed forms, dspeed's processors, or a fit by scipy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import curve_fit
from scipy.signal import lfilter
from scipy.special import expit, ndtr

from cpunet.errors import CpunetError
from cpunet.pulses import shape_parameters
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import PARAMETERS, pulse_parameters
from cpunet.pulses.shape_parameters import (
    FAST_DECAY_NS,
    SHAPE_PARAMETERS,
    TIME_POINTS,
    all_parameters,
)
from cpunet.recipes import load_recipe
from synthetic import PREPARATION

DT_NS = 16.0
TIME = np.arange(800.0)
FROM_STEP = np.clip(TIME - 400, 0, None)

SCORES = load_recipe("fast").scores.model_copy(update={"bootstraps": 10})


def parameters_of(waveforms: np.ndarray) -> dict[str, np.ndarray]:
    pulses = Pulses.of(np.atleast_2d(waveforms), dt_ns=DT_NS)
    return all_parameters(pulses, PREPARATION, SCORES)


def decaying(charge: np.ndarray, tau_us: float) -> np.ndarray:
    """What an RC circuit makes of the charge."""
    return lfilter([1, -1], [1, -np.exp(-DT_NS * 1e-3 / tau_us)], charge)


def multi_site(n: int, noise: float, seed: int) -> np.ndarray:
    """Pulses of three steps anywhere on the edge, with a decay and noise."""
    rng = np.random.default_rng(seed)
    charge = np.zeros((n, len(TIME)))
    for _ in range(3):
        edge = ndtr((TIME - rng.uniform(250, 395, (n, 1))) / rng.uniform(0.5, 12, (n, 1)))
        charge += rng.uniform(0.1, 1, (n, 1)) * edge
    pulses = decaying(charge / charge[:, -1:], 50.0)
    return (pulses + rng.normal(0, noise, pulses.shape)).astype(np.float32)


def smoothed_current(waveforms: np.ndarray) -> np.ndarray:
    """The current of dspeed's own chain, on the fine grid."""
    from dspeed.processors import avg_current, moving_window_multi, upsampler

    n, length = waveforms.shape
    current = np.empty((n, length - 1), np.float32)
    avg_current(waveforms, 1, current)
    fine = np.empty((n, (length - 2) * 16), np.float32)
    upsampler(current, 16, fine)
    smooth = np.empty_like(fine)
    moving_window_multi(fine, 48, 3, 0, smooth)
    return smooth


# --- times --------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [30, 97, 200])
def test_times_and_areas_of_a_ramp(samples):
    found = parameters_of(np.clip((TIME - 400 + samples) / samples, 0, 1))
    rise_ns = samples * DT_NS
    for name, fraction in TIME_POINTS.items():
        assert found[name] == pytest.approx((fraction - 1) * rise_ns, abs=0.01)
    assert found["rise_10_90"] == pytest.approx(0.8 * rise_ns, abs=0.01)
    assert found["rise_01_90"] == pytest.approx(0.89 * rise_ns, abs=0.01)
    assert found["rise_01_99"] == pytest.approx(0.98 * rise_ns, abs=0.01)
    assert found["rise_10_99"] == pytest.approx(0.89 * rise_ns, abs=0.01)
    assert found["rise_90_99"] == pytest.approx(0.09 * rise_ns, abs=0.01)
    assert found["drift_time"] == pytest.approx(0.99 * rise_ns, abs=0.01)
    # triangles: of height 0.99 and 0.2
    assert found["effective_drift_time"] == pytest.approx(0.99**2 / 2 * rise_ns, abs=0.01)
    assert found["late_charge"] == pytest.approx(0.2**2 / 2 * rise_ns, abs=0.01)


@pytest.mark.parametrize(("centre", "scale"), [(300.0, 6.0), (311.3, 9.0)])
def test_times_and_areas_of_a_logistic_edge(centre, scale):
    found = parameters_of(expit((TIME - centre) / scale))
    for name, fraction in TIME_POINTS.items():
        crossing = centre + scale * np.log(fraction / (1 - fraction))
        # straight lines between samples miss a curve by a hundredth of a sample or so
        assert found[name] == pytest.approx((crossing - 400) * DT_NS, abs=0.03 * DT_NS)
    # the integral of 1 - expit(x) from x is log(1 + exp(-x))
    area = scale * np.log(1 + 99)
    assert found["effective_drift_time"] == pytest.approx(area * DT_NS, rel=1e-3)
    late = scale * np.log(1.25)
    assert found["late_charge"] == pytest.approx(late * DT_NS, rel=5e-3)


def last_crossing(pulse: np.ndarray, level: float) -> float:
    top = int(np.argmax(pulse))
    below = np.flatnonzero(pulse[:top] < level)[-1]
    return float(np.interp(level, pulse[below : below + 2], [below, below + 1]))


def area_above(pulse: np.ndarray, height: float, start: float, stop: int) -> float:
    """Trapezoids between the height and the pulse, which is linear between samples."""
    grid = np.concatenate([[start], np.arange(np.floor(start) + 1, stop + 1)])
    return float(np.trapezoid(1 - np.interp(grid, np.arange(len(pulse)), pulse) / height, grid))


def test_times_and_effective_drift_time_of_noisy_pulses():
    waveforms = multi_site(40, 2e-3, seed=1)
    found = parameters_of(waveforms)
    for i, pulse in enumerate(waveforms.astype(float)):
        for name, fraction in TIME_POINTS.items():
            expected = (last_crossing(pulse, fraction * pulse.max()) - 400) * DT_NS
            assert found[name][i] == pytest.approx(expected, abs=0.02)
        start = last_crossing(pulse, 0.01 * pulse.max())
        area = area_above(pulse, pulse.max(), start, int(pulse.argmax()))
        assert found["effective_drift_time"][i] == pytest.approx(area * DT_NS, abs=0.05)


# --- current ------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 7.5e-4, 0.05])
def test_current_amplitude_equals_dspeeds_own_chain(noise):
    from dspeed.processors import min_max

    waveforms = multi_site(300, noise, seed=2)
    _, _, _, expected = min_max(smoothed_current(waveforms))
    assert np.abs(parameters_of(waveforms)["current_amplitude"] - expected).max() < 1e-6


@pytest.mark.parametrize("noise", [0.0, 7.5e-4, 0.01])
def test_current_width_is_that_of_dspeeds_own_chain(noise):
    waveforms = multi_site(100, noise, seed=3)
    found = parameters_of(waveforms)["current_width"]
    for current, width in zip(smoothed_current(waveforms).astype(float), found, strict=True):
        top, half = int(current.argmax()), current.max() / 2
        left = np.flatnonzero(current[:top] <= half)[-1]
        right = top + np.flatnonzero(current[top:] <= half)[0]
        begin = np.interp(half, current[left : left + 2], [left, left + 1])
        end = np.interp(half, current[[right, right - 1]], [right, right - 1])
        assert width == pytest.approx((end - begin) * DT_NS / 16, abs=0.05)


@pytest.mark.parametrize("sigma", [3.0, 6.0, 12.0, 25.0])
@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_current_of_a_gaussian(sigma, offset):
    found = parameters_of(ndtr((TIME - 300 - offset) / sigma))
    # variances add: differences and steps of one sample, and three averages over three
    width = np.sqrt(sigma**2 + (1 + 1 + 3 * 9) / 12)
    fwhm = 2 * np.sqrt(2 * np.log(2)) * width
    assert found["current_width"] == pytest.approx(fwhm * DT_NS, rel=5e-3)
    assert found["current_amplitude"] == pytest.approx(
        1 / (np.sqrt(2 * np.pi) * width), rel=1e-2
    )


def test_current_width_of_a_ramp_is_its_length():
    found = parameters_of(np.clip((TIME - 300) / 80, 0, 1))
    assert found["current_width"] == pytest.approx(80 * DT_NS, abs=0.1)


# --- tail ---------------------------------------------------------------------------


@pytest.mark.parametrize("tau_us", [20.0, 50.0, 300.0])
def test_one_decay(tau_us):
    found = parameters_of(decaying(np.clip((TIME - 350) / 50, 0, 1), tau_us))
    assert found["tail_slope"] == pytest.approx(-1e3 / tau_us, rel=1e-4)
    assert found["slow_tail_slope"] == pytest.approx(-1e3 / tau_us, abs=5e-3)
    assert found["fast_share"] == pytest.approx(0, abs=5e-3)
    assert found["tail_rms"] < 1e-6
    # without its decay the pulse is the ramp again
    assert found["late_charge"] == pytest.approx(0.02 * 50 * DT_NS, abs=0.1)
    assert found["overshoot"] == pytest.approx(0, abs=2e-3)


@pytest.mark.parametrize("tau_us", [30.0, 50.0, 400.0])
@pytest.mark.parametrize("share", [-0.02, 0.01, 0.05, 0.3])
def test_two_decays(tau_us, share):
    time_us = (TIME - 400) * DT_NS * 1e-3
    tail = (1 - share) * np.exp(-time_us / tau_us) + share * np.exp(
        -time_us / (FAST_DECAY_NS * 1e-3)
    )
    found = parameters_of(np.where(TIME < 400, 0, 0.9 * tail))
    assert found["fast_share"] == pytest.approx(100 * share, abs=5e-3)
    assert found["slow_tail_slope"] == pytest.approx(-1e3 / tau_us, abs=5e-3)
    assert found["tail_rms"] < 1e-6


def test_two_decays_of_noisy_tails_are_those_of_a_general_fit():
    rng = np.random.default_rng(4)
    time_ms = (TIME[500:] - 400) * DT_NS * 1e-6
    fast = np.exp(-time_ms / (FAST_DECAY_NS * 1e-6))
    waveforms = np.where(TIME < 400, 0, np.exp(-FROM_STEP / 3200)) + rng.normal(
        0, 0.01, (20, 800)
    )
    waveforms[:, 500:] += 0.05 * fast
    found = parameters_of(waveforms)

    def model(time, slow, rate, quick):
        return slow * np.exp(-rate * time) + quick * fast

    for i, tail in enumerate(waveforms[:, 500:].astype(np.float32).astype(float)):
        (slow, rate, quick), _ = curve_fit(model, time_ms, tail, p0=(1, 20, 0), xtol=1e-14)
        residuals = tail - model(time_ms, slow, rate, quick)
        assert found["slow_tail_slope"][i] == pytest.approx(-rate, abs=1e-3)
        assert found["fast_share"][i] == pytest.approx(100 * quick / (slow + quick), abs=1e-3)
        assert found["tail_rms"][i] == pytest.approx(np.sqrt(residuals @ residuals / 297), 1e-5)


def test_a_slow_decay_as_fast_as_the_fast_one_has_no_two_decays():
    found = parameters_of(np.where(TIME < 400, 0, np.exp(-FROM_STEP * DT_NS / 4000)))
    assert found["tail_slope"] == pytest.approx(-250, rel=1e-4)
    for name in ("slow_tail_slope", "fast_share", "tail_rms"):
        assert np.isnan(found[name]).all()


# --- pole-zero corrected shape ------------------------------------------------------


@pytest.mark.parametrize("height", [0.01, 0.05])
@pytest.mark.parametrize("fall", [3.0, 8.0])
def test_a_step_with_overshoot(height, fall):
    charge = np.where(TIME < 400, 0, 1 + height * np.exp(-FROM_STEP / fall))
    found = parameters_of(decaying(charge, 50.0))
    assert found["overshoot"] == pytest.approx(100 * height, abs=5e-3)
    # above 80 % on the way up, and then all that is above the plateau
    rising = (0.2 + height) / (1 + height) * (0.2 - height) / 2
    falling = height * (1 / (1 - np.exp(-1 / fall)) - 0.5)
    assert found["late_charge"] == pytest.approx((rising - falling) * DT_NS, abs=0.1)


def test_charge_that_comes_late():
    tau = 12.0  # samples
    late = 0.3
    charge = np.where(TIME < 380, 0, 1 - late * np.exp(-(TIME - 380) / tau))
    found = parameters_of(decaying(charge, 60.0))
    start = 380 + tau * np.log(late / 0.2)
    assert start > 384  # at 80 % only part of the late charge is still to come
    assert found["late_charge"] == pytest.approx(0.2 * tau * DT_NS, rel=5e-3)


def test_late_charge_and_overshoot_of_noisy_pulses():
    waveforms = multi_site(40, 2e-3, seed=5)
    found = parameters_of(waveforms)
    for i, pulse in enumerate(waveforms.astype(float)):
        slope = np.polyfit(np.arange(300), np.log(pulse[500:]), 1)[0]
        corrected = lfilter([1, -np.exp(slope)], [1, -1], pulse)
        plateau = corrected[500:].mean()
        assert found["overshoot"][i] == pytest.approx(
            100 * (corrected[:500].max() / plateau - 1), abs=1e-3
        )
        start = last_crossing(corrected[:500], 0.8 * plateau)
        area = area_above(corrected, plateau, start, 799)
        assert found["late_charge"][i] == pytest.approx(area * DT_NS, abs=0.05)


# --- baseline -----------------------------------------------------------------------


def test_baseline_rms_is_that_about_a_line():
    waveforms = multi_site(20, 3e-3, seed=6) + np.float32(1e-4) * TIME.astype(np.float32)
    found = parameters_of(waveforms)["baseline_rms"]
    for pulse, rms in zip(waveforms.astype(float), found, strict=True):
        fit = np.polyfit(TIME[:200], pulse[:200], 1, full=True)
        assert rms == pytest.approx(np.sqrt(fit[1][0] / 198), rel=1e-6)


def test_a_tilted_baseline_has_no_rms():
    found = parameters_of(1e-3 * TIME)
    assert found["baseline_rms"] == pytest.approx(0, abs=1e-7)


# --- all of them --------------------------------------------------------------------


def test_the_three_parameters_of_the_paper_are_among_them():
    waveforms = multi_site(20, 1e-3, seed=7)
    found = parameters_of(waveforms)
    assert list(found) == list(SHAPE_PARAMETERS)
    expected = pulse_parameters(Pulses.of(waveforms, dt_ns=DT_NS), PREPARATION, SCORES)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)
        assert SHAPE_PARAMETERS[name].axis_label == PARAMETERS[name].axis_label
    for values in found.values():
        assert values.dtype == np.float64
        assert values.shape == (20,)
        assert np.isfinite(values).all()


def test_what_depends_on_height_and_what_does_not():
    waveforms = multi_site(20, 1e-3, seed=8)
    one, four = parameters_of(waveforms), parameters_of(4 * waveforms)
    for name, values in one.items():
        factor = 4 if name in ("current_amplitude", "tail_rms", "baseline_rms") else 1
        assert four[name] == pytest.approx(factor * values, rel=1e-5, abs=1e-5), name


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("sample", [0, 390, 799])
def test_a_value_that_is_not_finite_gives_nan_for_that_pulse_only(bad, sample):
    waveforms = multi_site(5, 1e-3, seed=9)
    expected = parameters_of(waveforms)
    waveforms[2, sample] = bad
    for name, values in parameters_of(waveforms).items():
        assert np.isnan(values).tolist() == [False, False, True, False, False], name
        others = [0, 1, 3, 4]
        assert values[others] == pytest.approx(expected[name][others], rel=1e-9, abs=1e-9)


def test_a_constant_pulse_has_neither_times_nor_charge():
    found = parameters_of(np.full(800, 0.5))
    zero = ("current_amplitude", "overshoot", "tail_slope", "baseline_rms", "tail_rms")
    for name in zero:
        assert found[name] == pytest.approx(0, abs=1e-12), name
    for name in (*TIME_POINTS, "rise_10_90", "drift_time", "effective_drift_time"):
        assert np.isnan(found[name]).all(), name
    assert np.isnan(found["late_charge"]).all()
    assert np.isnan(found["current_width"]).all()


@pytest.mark.parametrize("offset", [0.0, -0.5])
def test_a_negative_pulse_has_neither_times_nor_tail(offset):
    found = parameters_of(offset - np.clip((TIME - 350) / 50, 0, 1))
    for name, values in found.items():
        if name not in ("current_amplitude", "baseline_rms"):
            assert np.isnan(values).all(), name
    assert found["current_amplitude"] == 0
    assert found["baseline_rms"] == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize(
    "pulse",
    [
        np.zeros(800),
        np.full(800, 3e38),
        np.where(TIME % 2, 3e38, -3e38),
        np.where(TIME == 400, 1.0, 0.0),
        np.where(TIME == 0, 1.0, 0.0),
        np.where(TIME == 799, 1.0, 0.0),
        np.exp(np.minimum(TIME - 720, 80)),
        np.exp(-TIME),
        1e-38 * TIME,
        np.random.default_rng(10).normal(size=800),
    ],
)
def test_odd_pulses_give_numbers_or_nan_without_a_warning(pulse):
    for values in parameters_of(pulse).values():
        assert not np.isinf(values).any()


def test_parameters_do_not_depend_on_blocks(monkeypatch):
    waveforms = multi_site(20, 1e-3, seed=11)
    whole = parameters_of(waveforms)
    monkeypatch.setattr(shape_parameters, "BLOCK", 3)
    for name, values in parameters_of(waveforms).items():
        assert values == pytest.approx(whole[name], rel=1e-9, abs=1e-9), name


def test_the_pulses_are_left_as_they_are():
    waveforms = multi_site(3, 1e-3, seed=12)
    waveforms[1, 5] = np.nan
    kept = waveforms.copy()
    parameters_of(waveforms)
    np.testing.assert_array_equal(waveforms, kept)


def test_no_pulses_give_no_values():
    found = parameters_of(np.zeros((0, 800)))
    assert {values.shape for values in found.values()} == {(0,)}


def test_pulses_of_another_length_are_refused():
    with pytest.raises(CpunetError, match="the pulses have 799 samples and prepared ones 800"):
        parameters_of(np.zeros((2, 799)))


def test_the_documented_table_is_the_registry():
    page = Path(__file__).parents[2] / "docs" / "parameters.md"
    rows = [line for line in page.read_text().splitlines() if line.startswith("| `")]
    assert rows == [
        f"| `{name}` | {p.unit} | {p.definition} | {p.source} |"
        for name, p in SHAPE_PARAMETERS.items()
    ]
