"""Any step response: exact derivatives, a readout that no chain describes, and the verdict."""

from __future__ import annotations

import copy
from functools import partial

import numpy as np
import pytest

from cpunet.networks.response_layer import LATE_NS, ElectronicsResponse, deviation_lags, padding
from cpunet.training.aligned import Derivatives
from cpunet.training.chain_description import TIMES_NS, learned_chain, reaches_ns, true_chain_of
from cpunet.training.chain_fit import with_settings
from cpunet.training.comparison import Comparison
from cpunet.training.deviations import with_deviations
from cpunet.training.pulse_sets import PulseSets, Sides
from cpunet.training.verdict import PARTS, Verdict, verdict
from synthetic import load_recipe
from unpaired import CHAIN, DT_NS, Unpaired, charge, faster, measured_with, simulated

RECIPE = load_recipe("fast", ["generator.slow_ns=[400]", "generator.fast_decays_us=[]"])
RINGING = {"fraction": 0.05, "frequency_MHz": 3.0, "damping_ns": 300.0}
RINGS = type(CHAIN).model_validate(CHAIN.model_dump() | {"ringing": RINGING})


def true_response(poles_ns: tuple[float, float] = (55.0, 35.0)) -> ElectronicsResponse:
    """The chain that the data went through."""
    known = {"poles_ns": poles_ns, "decay_us": CHAIN.decays[0].tau_us}
    config = RECIPE.generator.model_copy(update=known)
    response = ElectronicsResponse(config, DT_NS)
    response.slow_weights.fill(0.065)
    return response


def sides_of(sets: Unpaired) -> Sides:
    (sides,) = PulseSets(*sets, RECIPE, np.random.default_rng(0)).sides()
    return sides


@pytest.fixture(scope="module")
def plain() -> Unpaired:
    return measured_with(CHAIN, 1500)


@pytest.fixture(scope="module")
def rings() -> Unpaired:
    return measured_with(RINGS, 1000)


def deviating(response: ElectronicsResponse, deviation: np.ndarray) -> ElectronicsResponse:
    own = ElectronicsResponse(response.config.model_copy(update={"deviations": True}), DT_NS)
    own.fill(own.arrays() | response.arrays())
    own.deviation[:] = deviation
    return own


def test_at_the_truth_chi_square_is_one_and_the_chain_stays_as_it_is(plain):
    response, sides = true_response(), sides_of(plain)
    found = Comparison(sides, response.transfer(sides.padded), 1.5).differences()
    assert np.mean([d.chi_square for d in found if d.sliced]) == pytest.approx(1.0, abs=0.15)
    assert all(d.chi_square < 1.6 for d in found)
    assert with_deviations(response, [sides], lambda _: None)[0] is response


@pytest.mark.parametrize("at_ns", [320.0, 2000.0])
def test_derivatives_are_those_of_differences(plain, at_ns):
    """With little noise, of which slices with other pulses have other means."""
    response = true_response()
    sides, lags = sides_of(plain), deviation_lags(DT_NS)
    sides.noise.factor = 1e-4 * sides.noise.factor
    change = np.exp(-0.5 * ((lags * DT_NS - at_ns) / 60.0) ** 2)
    basis, step = change[:, np.newaxis], 1e-4
    found, *ends = (
        Comparison(sides, deviating(response, size * change).transfer(sides.padded), 6.0)
        for size in (0.0, step, -step)
    )
    found = found.differences(partial(Derivatives, basis))
    ends = [end.differences() for end in ends]
    for k, (here, up, down) in enumerate(zip(found[2:], ends[0][2:], ends[1][2:], strict=True)):
        wanted = (up.values - down.values) / (2 * step)
        off = np.linalg.norm(here.slopes[:, 0] - wanted) / np.linalg.norm(wanted)
        assert off < 0.1, k


def test_a_ringing_is_learned_and_its_lack_is_bad(rings):
    """The mean pulse tells what moments of a chain do not."""
    response, sides = true_response(), sides_of(rings)
    bad = verdict(response, [sides])[0]
    assert not bad.good
    assert abs(bad.z) > 10
    assert {"edge", "top"} & set(bad.off)
    found, _ = with_deviations(response, [sides], lambda _: None)
    assert verdict(found, [sides])[0].good
    # from the half height, since pulses do not tell a delay
    time_ns, steps = np.arange(-50, 1500.0, 4), []
    for chain in (learned_chain(found, ""), true_chain_of(RINGS), true_chain_of(CHAIN)):
        half_ns = reaches_ns(chain.step(TIMES_NS), 0.5)
        steps.append(chain.step(time_ns + half_ns) / chain.step(3000.0))
    assert np.abs(steps[0] - steps[1]).max() < 0.002
    assert np.abs(steps[2] - steps[1]).max() > 0.008


@pytest.mark.parametrize("factor", [0.9, 1.15])
def test_other_physics_are_bad(plain, factor):
    """No linear readout makes up for a drift that is longer or shorter."""
    sides = sides_of(plain._replace(sim=simulated(faster(charge(1500, seed=1), factor))))
    found, _ = with_deviations(true_response(), [sides], lambda _: None)
    told, _ = verdict(found, [sides])
    assert not told.good
    assert told.causes


def test_what_a_verdict_says():
    right = {"chi_square": 1.02, "amplitude": 0.9, "z": -2.5, "z_ns": 40.0, "beyond_ns": []}
    right |= {"off": {}, "pulses": [1000, 900]}
    good = Verdict.model_validate(right)
    assert good.good
    assert good.causes == []
    assert str(good).startswith("good: the mean pulse is within 2.5 standard errors")
    wrong = {"z": 30.0, "beyond_ns": [300.0, 820.0], "off": {"top": 30.0, "onset": 9.0}}
    bad = Verdict.model_validate(right | wrong)
    assert not bad.good
    said = "is off by 30.0 standard errors, from 300 to 820 ns after the half height"
    assert said in str(bad)
    assert bad.causes[0] == f"the onset is off by 9.0 standard errors: {PARTS['onset'][1]}"
    seen = Verdict.model_validate(right | {"auc": 0.7, "auc_error": 0.02})
    assert not seen.good
    assert not Verdict.model_validate(right | {"chi_square": 1.4}).good


def test_a_deviation_acts_at_its_lags_and_decays_with_the_chain():
    response, lags = true_response(), deviation_lags(DT_NS)
    deviation = 0.01 * np.exp(-0.5 * ((lags * DT_NS - 800) / 100) ** 2) + 0.004
    own = deviating(response, deviation)
    padded, last = 8192, int(lags[-1])
    plain, moved = (np.fft.irfft(one.transfer(padded), padded) for one in (response, own))
    apart = moved - plain
    np.testing.assert_allclose(apart[: last + 1], deviation[-lags[0] :], atol=1e-12)
    np.testing.assert_allclose(apart[lags[0] :], deviation[: -lags[0]], atol=1e-12)
    early, late = (round(ns / DT_NS) for ns in LATE_NS)
    rate = np.log(moved[late] / moved[early]) / (late - early)
    tail = moved[last] * np.exp(rate * np.arange(4000 - last))
    np.testing.assert_allclose(moved[last:4000], tail, atol=1e-9)
    # records are those of its closed form, sampled as means over the period
    step = np.float32(np.arange(1600) >= 400)[np.newaxis]
    record = own(step)[0][padding(DT_NS)[0] + 400 :]
    time_ns = (np.arange(1000) + 0.5) * DT_NS
    closed = learned_chain(copy.deepcopy(own), "").step(time_ns)
    np.testing.assert_allclose(record[30:1000], closed[30:], atol=3e-4)
    assert own.describe()["deviation"] == pytest.approx(0.014)
    # a fit that starts from it starts without
    start = with_settings(own, deviations=False)
    np.testing.assert_array_equal(start.transfer(padded), true_response().transfer(padded))


def test_a_deviation_is_the_same_at_other_sampling_periods():
    """As for the templates of a library, which are sampled every ns."""
    lags = deviation_lags(DT_NS)
    own = deviating(true_response(), 0.01 * np.exp(-0.5 * ((lags * DT_NS - 500) / 80) ** 2))
    fine = copy.deepcopy(own)
    fine.dt_ns.fill(1.0)
    both = ((own, 4096), (fine, 40_960))
    steps = [np.fft.irfft(one.transfer(padded), padded) for one, padded in both]
    time_ns = (np.arange(5, 200) + 0.5) * DT_NS  # samples are means over their period
    coarse, same = steps[0][5:200], np.interp(time_ns, np.arange(40_960) + 0.5, steps[1])
    np.testing.assert_allclose(coarse[15:], same[15:], atol=2e-4)
