"""What calibrations try, and what held-out pulses say of it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training import fitter as fitter_module
from cpunet.training import response_starts
from cpunet.training.fitter import (
    Fitted,
    Fitter,
    Gain,
    HeldOutPulses,
    compared,
    held_out_gain,
    split,
)
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_problem import Band, ResponseProblem
from synthetic import load_recipe
from unpaired import CHAIN, DT_NS, measured_with

RECIPE = load_recipe("fast", ["generator.slow_ns=[400]", "generator.fast_decays_us=[]"])


@pytest.fixture(scope="module")
def bands() -> list[Band]:
    sim, data, noise = measured_with(CHAIN)
    rng = np.random.default_rng(0)
    return PulseSets(sim[:300], data[:300], noise, RECIPE, rng).bands()


def test_what_is_held_out_is_in_no_fit(bands):
    (known,), (held,) = split(bands, 0.2, np.random.default_rng(0))
    assert not set(held.rows) & set(known.rows)
    assert len(held.rows) + len(known.rows) == len(bands[0].rows)


@pytest.mark.parametrize(("gain", "best"), [(0.0, 0), (0.02, 0), (0.5, 2), (-0.5, 0)])
def test_only_what_held_out_pulses_gain_is_kept(gain, best):
    """Of distances from the data that fall by `gain` of a standard deviation in two steps."""
    rng = np.random.default_rng(0)
    data, sim = rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
    of = SimpleNamespace(whiten=np.eye(3), sigma=np.full(3, 200**-0.5))
    held = []
    for part in (1.0, 0.5, 0.0):
        one = object.__new__(HeldOutPulses)
        off = part * gain if gain > 0 else (part - 1) * gain
        sides = ((values, np.ones(200)) for values in (sim + off, data))
        one.sides, one.comparisons, one.scales = [tuple(sides)], [of], [1.0]
        held.append([one])
    found = compared(held, seed=0)
    assert found.best == best
    assert found.error[0] == 0


def test_a_response_near_the_truth_gains(bands):
    """And those that are compared stay as they are."""

    def with_poles(*poles_ns: float) -> ElectronicsResponse:
        of_chain = {"poles_ns": poles_ns, "decay_us": CHAIN.decays[0].tau_us}
        response = ElectronicsResponse(RECIPE.matching[0].model_copy(update=of_chain), DT_NS)
        response.slow_weights.fill(0.065)
        return response

    true, slow = with_poles(55, 35), with_poles(90, 60)
    fitter = Fitter(RECIPE.matching[1])
    fitter.follow = lambda _problem: None  # type: ignore[method-assign,assignment,return-value]
    gain = held_out_gain([(slow, None), (true, None)], bands, fitter)
    assert gain.best == 1
    assert held_out_gain([(true, None), (slow, None)], bands, fitter).best == 0
    assert slow.describe()["pole_1_ns"] == pytest.approx(90)


def test_what_lowers_chi_square_is_kept_only_if_held_out_pulses_gain(monkeypatch, bands):
    response = ElectronicsResponse(RECIPE.matching[0], DT_NS)
    problem = ResponseProblem(response, bands)
    fitter = Fitter(RECIPE.matching[1])
    before, after = (Fitted(problem, cost, np.eye(1)) for cost in (200.0, 100.0))
    for mismatch, kept in ((0.9, True), (1.9, False)):
        gain = Gain([2.0, mismatch], [0.0, 0.1])
        monkeypatch.setattr(response_starts, "held_out_gain", lambda *_, gain=gain: gain)
        assert response_starts.gains("a ringing", before, after, fitter) == kept
        assert fitter.gains["a ringing"].startswith("kept" if kept else "left out")
    assert str(gain) == "chi-square of held-out pulses 2.00 → 1.90 ± 0.10 per moment"
    assert not response_starts.gains("a ringing", after, before, fitter)
    assert fitter_module.SURE == 2.0
