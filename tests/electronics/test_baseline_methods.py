"""Baseline methods against known responses, applied to other events on a finer grid."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from cpunet.electronics.baseline_methods import (
    BASELINE_METHODS,
    LEAD_NS,
    BaselineMethod,
    crossing,
    gauss_exp,
)
from cpunet.electronics.chain import Exponentials
from cpunet.electronics.finishing import finish, record_length
from cpunet.errors import CpunetError
from cpunet.legend.export import kernel_step
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import prepare
from synthetic import load_recipe, paired_scores

CONFIG = load_recipe("paper").preparation
DT_NS, ALIGN = 16.0, CONFIG.samples_before
DECAY_NS = 54_600.0
STEPS = 4  # of the fine grid per sample
FINE_NS = DT_NS / STEPS
N_FINE = 1200 * STEPS
TIME_NS = np.arange(N_FINE) * FINE_NS
NOISE = 4e-4  # of the pulse height, as in a good detector
RC_LATE = {"tau_ns": (60, 0.1), "late_share": (0.07, 0.2), "late_ns": (500, 0.35)}
NARROW, WIDE = ({"sigma_ns": (s, 0.03), "tau_ns": (t, 0.03)} for s, t in ((30, 60), (20, 90)))


def ideal(n: int, seed: int) -> FloatArray:
    """Charge pulses on the fine grid: slow drift, then the fast rise at the contact.

    One to three interactions each, smeared by a charge cloud of some 10 ns.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(N_FINE) * FINE_NS - 500 * DT_NS - rng.uniform(0, DT_NS, (n, 1))
    pulses = np.zeros((n, N_FINE), np.float32)
    for _ in range(3):
        share = rng.exponential(1, (n, 1)) * (rng.random((n, 1)) < 0.4) + 1e-3
        end = rng.uniform(300, 1100, (n, 1))
        width = rng.uniform(10, 16, (n, 1))
        rise = 1 / (1 + np.exp(np.clip((end - time) / width, -60, 60)))
        slow = np.clip(time / end, 0, 1) ** 2
        pulses += (share * (0.25 * slow + 0.75 * rise)).astype(np.float32)
    return (pulses / pulses[:, -1:]).astype(np.float32)


def sampled(fine: FloatArray) -> FloatArray:
    return fine[:, ::STEPS]


def decayed(steps: FloatArray) -> FloatArray:
    """Exponential decay of every bit of charge."""
    kept = np.exp(-DT_NS / DECAY_NS)
    return scipy.signal.lfilter([1, -1], [1, -kept], steps, axis=1).astype(np.float32)


def behind(fine: FloatArray, step: np.ndarray) -> FloatArray:
    """Samples of pulses behind a circuit, given its response to a step at `TIME_NS`."""
    current = np.diff(fine, axis=1, prepend=0)
    response = scipy.signal.fftconvolve(current, step[np.newaxis], axes=1)
    return sampled(response[:, : fine.shape[1]].astype(np.float32))


def simulated(fine: FloatArray) -> FloatArray:
    return prepare(Pulses.of(sampled(fine), dt_ns=DT_NS), CONFIG, "simulated").pulses.waveforms


def measured(records: FloatArray, noise: float = NOISE, seed: int = 5) -> FloatArray:
    """Prepared windows of noise-free records."""
    rng = np.random.default_rng(seed)
    noisy = (records + rng.normal(0, noise, records.shape)).astype(np.float32)
    return prepare(Pulses.of(noisy, dt_ns=DT_NS), CONFIG, "measured").pulses.waveforms


@pytest.fixture(scope="module")
def sim() -> FloatArray:
    return simulated(ideal(800, seed=1))


@pytest.fixture(scope="module")
def other_fine() -> FloatArray:
    return ideal(800, seed=2)


def gauss_exp_step(sigma_ns: float, tau_ns: float) -> np.ndarray:
    return kernel_step(TIME_NS - 6 * sigma_ns, sigma_ns, tau_ns)


def rc_late_step(tau_ns: float, late_share: float, late_ns: float) -> np.ndarray:
    late = Exponentials.low_pass(late_ns, late_share)
    return (Exponentials.low_pass(tau_ns) * late).step(TIME_NS)


@pytest.mark.parametrize(
    ("name", "step", "wanted"),
    [
        ("gauss_exp", gauss_exp_step, NARROW),
        pytest.param("gauss_exp", gauss_exp_step, WIDE, marks=pytest.mark.thorough),
        ("rc_late", rc_late_step, RC_LATE),
    ],
)
def test_kernels_are_recovered(sim, other_fine, name, step, wanted) -> None:
    response = behind(other_fine, step(*(value for value, _ in wanted.values())))
    found = BASELINE_METHODS[name](sim, measured(decayed(response)), DT_NS, ALIGN).values
    for value, (true, error) in wanted.items():
        assert found[value] == pytest.approx(true, rel=error)
    assert found["tail_slope_per_ms"] == pytest.approx(-1e6 / DECAY_NS, rel=0.01)


@pytest.mark.parametrize("tau_ns", [DT_NS, 50.0, 100.0])
def test_rc_recovers_its_time_constant(sim, other_fine, tau_ns) -> None:
    """From a period on, behind which pulses are fast enough."""
    rate = DT_NS / tau_ns
    response = scipy.signal.lfilter([0, rate], [1, rate - 1], sampled(other_fine), axis=1)
    method = BASELINE_METHODS["rc"](sim, measured(decayed(response)), DT_NS, ALIGN)
    assert method.values["tau_ns"] == pytest.approx(tau_ns, rel=0.05)


def test_superpulse_reproduces_a_kernel(sim, other_fine) -> None:
    """One that no method with parameters can take on: fast, and a slow part."""
    fast = Exponentials.low_pass(40.0) * Exponentials.low_pass(40.1)
    circuit = fast * Exponentials.low_pass(300.0, 0.07)
    data = measured(decayed(behind(other_fine, circuit.step(TIME_NS))))
    method = BASELINE_METHODS["superpulse"](sim, data, DT_NS, ALIGN)
    lead, length = round(LEAD_NS / DT_NS), record_length(CONFIG.length, DT_NS)
    steps = np.cumsum(np.roll(scipy.fft.irfft(method.transfer, length), lead))[np.newaxis]
    true = circuit.step(np.arange(200) * DT_NS)
    at, true_at = crossing(steps, 0.5)[0], crossing(true[np.newaxis], 0.5)[0]
    shifted = np.interp(np.arange(60) - at + true_at, np.arange(200), true, left=0.0)
    # the step of the free kernel keeps the band that the pulses have
    np.testing.assert_allclose(steps[0, :60], shifted, atol=0.06)
    np.testing.assert_allclose(steps[0, lead + 8 : 60], shifted[lead + 8 :], atol=0.01)


@settings(max_examples=8)
@given(sigma_ns=st.floats(16, 50), tau_ns=st.floats(16, 150))
def test_windows_are_those_of_the_true_response(sigma_ns: float, tau_ns: float) -> None:
    """Response of a window, extended, and window of the response are the same."""
    fine = ideal(20, seed=3)
    true = behind(fine, gauss_exp_step(sigma_ns, tau_ns))
    truth = finish(decayed(true), CONFIG, dt_ns=DT_NS).windows
    s = 2j * np.pi * scipy.fft.rfftfreq(record_length(CONFIG.length, DT_NS), DT_NS)
    decay = {"tail_slope_per_ms": -1e6 / DECAY_NS}
    method = BaselineMethod(DT_NS, gauss_exp(s, sigma_ns, tau_ns), decay)
    windows = finish(method.translate(simulated(fine)), CONFIG, dt_ns=DT_NS).windows
    scores = paired_scores(windows, truth, 100)
    # What a response computed at 16 ns instead of on the fine grid costs: up to 5.0e-4
    # at the narrowest kernel drawn here, one sample wide.
    assert scores.edge_rmse < 8e-4
    assert scores.unaligned == 0


def test_bad_input_is_named(sim) -> None:
    for method in BASELINE_METHODS.values():
        with pytest.raises(CpunetError, match=r"7 simulated pulses; give \d+ or more"):
            method(sim[:7], sim, DT_NS, ALIGN)
    with pytest.raises(CpunetError, match="check their polarity"):
        BASELINE_METHODS["rc"](sim, -sim, DT_NS, ALIGN)
