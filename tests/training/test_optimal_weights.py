"""Optimally weighted functions: what they find, and what they leave alone."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import finish
from cpunet.networks.response_layer import ElectronicsResponse, record_length
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import current_amplitude
from cpunet.training.moments import Moments, Values
from cpunet.training.optimal_weights import Parts, Sums, WeightedMeans, jackknife_bias, refine
from cpunet.training.response_fit import amplitude_shift
from cpunet.training.response_problem import Band, Parameters, ResponseProblem, SmoothParameters
from cpunet.training.translated import Noise, SimulatedSide
from synthetic import drifting, load_recipe, two_sites

DT_NS, KEV, N = 16.0, 2614.5, 800
RECIPE = load_recipe(
    "fast", ["generator.slow_ns=[400]", "generator.fast_decays_us=[]", "training.components=8",
             "training.squares=4", "training.amplitude_bins=8"]
)  # fmt: skip
CONFIG, TRAINING = RECIPE.matching
WHITE = BaselineNoise(np.full(4097, (6e-4 * KEV) ** 2), 8192, DT_NS, 100)


def charge(seed: int) -> FloatArray:
    """Prepared pulses of one or two sites, each a drift and a steep end."""
    rng = np.random.default_rng(seed)

    def site() -> np.ndarray:
        drift = rng.uniform(20, 60, (N, 1))
        since = np.arange(800) - 400 + drift - rng.uniform(0, 1, (N, 1))
        return drifting(since, drift, 3, slow=0.4)

    return np.float32(two_sites(rng, N, site, single=0.4, least=0.2))


def response(poles_ns: tuple[float, float], slow: float) -> ElectronicsResponse:
    made = ElectronicsResponse(CONFIG, DT_NS)
    made.log_poles_ns[...] = np.log(poles_ns)
    made.log_decay_us.fill(float(np.log(80.0)))
    made.slow_weights.fill(slow)
    return made


def band_behind(poles_ns: tuple[float, float]) -> Band:
    """Pulses behind two poles, and others to be translated."""
    records = response(poles_ns, 0.05)(charge(1))
    energies = np.full(N, KEV)
    data = finish(
        records, RECIPE.preparation, dt_ns=DT_NS, noise=WHITE, energy_kev=energies, seed=3
    ).windows
    moments = Moments.of_data(data, TRAINING, RECIPE.preparation)
    noise = Noise.draw(WHITE, energies, record_length(800, 16.0), 2, np.random.default_rng(4))
    return Band("FEP", SimulatedSide(charge(2), noise, moments, np.ones(N)), np.arange(N))


@pytest.fixture(scope="module")
def band() -> Band:
    return band_behind((60.0, 40.0))


def test_the_chain_is_found_from_nearby_within_its_errors(band: Band) -> None:
    near = ResponseProblem(response((63.0, 39.0), 0.045), [band])
    refine(near, [band], 6)
    covariance = refine(near, [band], 6)
    errors = np.sqrt(covariance.diagonal())
    truth = np.array([np.log(60), np.log(40), np.log(80), 0.05])
    found = Parameters(near.response).vector()
    assert near.parameters.labels[:3] == ["log_poles_ns", "log_poles_ns", "log_decay_us"]
    assert (np.abs(found - truth) < 4 * errors).all()
    # together the poles are known far better than one by one
    together = np.array([0.6, 0.4, 0, 0])
    assert np.sqrt(together @ covariance @ together) < 0.003
    assert abs(together @ (found - truth)) < 0.01


def test_poles_are_told_apart_from_where_they_are_equal(band: Band) -> None:
    """Where they are equal, derivatives with their difference vanish."""
    near = ResponseProblem(response((49.0, 48.9), 0.05), [band])
    refine(near, [band], 6)
    poles = np.sort(np.exp(near.response.log_poles_ns))
    np.testing.assert_allclose(poles, [40, 60], atol=6)


def test_coordinates_are_those_of_the_poles_and_back() -> None:
    made = response((60.0, 40.0), 0.05)
    smooth, plain = SmoothParameters(made), Parameters(made)
    place, vector = smooth.vector(), plain.vector()
    np.testing.assert_allclose(place[0], np.log(2400) / 2)
    np.testing.assert_allclose(place[1], (np.log(1.5) / 2) ** 2)
    smooth.set(place + np.array([0, -1, 0, 0]))  # below 0 there are no real poles
    np.testing.assert_allclose(np.exp(made.log_poles_ns), 2400**0.5)
    smooth.set(place)
    np.testing.assert_allclose(np.exp(made.log_poles_ns), [60, 40])
    # derivatives of the coordinates with the parameters
    slopes = []
    for i in range(4):
        plain.set(vector + 1e-6 * np.eye(4)[i])
        slopes.append((smooth.vector() - place) / 1e-6)
    plain.set(vector)
    known = np.diag([1e4, 1e6, 1e4, 1e6])
    by_parameters = np.array(slopes) @ known @ np.transpose(slopes)
    covariance = np.linalg.inv(by_parameters + np.diag(plain.widths**-2.0))
    np.testing.assert_allclose(smooth.covariance(known), covariance, rtol=1e-4, atol=1e-9)


def test_coordinates_are_those_of_the_decays_and_back() -> None:
    made = ElectronicsResponse(load_recipe("fast").matching[0], DT_NS)
    smooth, plain = SmoothParameters(made, poles=False), Parameters(made)
    decay = plain.labels.index("log_decay_us")
    vector = plain.vector()
    vector[decay] += np.log(0.8)
    vector[-2:] = 0.05, -0.02
    plain.set(vector)
    place = smooth.vector()
    assert place[decay] == pytest.approx(0.97 * 0.25)
    smooth.set(place)
    np.testing.assert_allclose(plain.vector(), vector, rtol=1e-12)
    steps = 1e-6 * np.eye(len(vector))
    moved = [plain.set(vector + step) or smooth.vector() for step in steps]
    plain.set(vector)
    np.testing.assert_allclose(smooth.turn().T, (np.array(moved) - place) / 1e-6, atol=1e-5)


def test_the_amplitude_is_right_after_it_and_wrong_before(band: Band) -> None:
    off = response((66.0, 44.0), 0.05)
    shift, error = amplitude_shift(off, [band])
    assert shift > 5 * error  # a slower chain has lower currents than the data
    near = ResponseProblem(copy.deepcopy(off), [band])
    refine(near, [band], 6)
    refine(near, [band], 6)
    shift, error = amplitude_shift(near.response, [band])
    assert abs(shift) < 3 * error


@pytest.mark.parametrize("poles_ns", [(66.0, 44.0), (80.0, 80.0), (150.0, 150.0)])
def test_an_amplitude_that_is_far_off_is_told_as_it_is(
    band: Band, poles_ns: tuple[float, float]
) -> None:
    """Also where no translated amplitude is one of the data's."""
    pulses = charge(2)
    translated, true = (
        np.log(current_amplitude(response(poles, 0.05)(pulses), 16.0))
        for poles in (poles_ns, (60.0, 40.0))
    )
    shift, error = amplitude_shift(response(poles_ns, 0.05), [band])
    assert shift == pytest.approx((true - translated).mean(), rel=0.05)
    assert 0 < error < 0.01


PARTS, IN_PART, FUNCTIONS = 10, 40, 40
# How the functions, whose means are 1, change with each of two coordinates: where by chance
# they are larger, they change more.
OFFSET = 0.7
CHANGES = np.stack([np.linspace(0.5, 1.5, FUNCTIONS), np.linspace(-1, 1, FUNCTIONS) ** 2], 1)
WIDE = np.full(2, 1e3)


def sums(values: Values) -> Sums:
    """Sums over simulated pulses, (pulses, functions), as the coordinates change them."""
    moved = (values - OFFSET).sum(axis=0)[:, np.newaxis] * CHANGES
    return Sums(len(values), values.sum(axis=0), values.T @ values, moved)


def sides(seed: int) -> tuple[list[Sums], list[Sums]]:
    """Both sides of one experiment in parts: skewed functions, as of bins with few pulses."""
    drawn = np.random.default_rng(seed).exponential(size=(2, PARTS, IN_PART, FUNCTIONS))
    return [sums(part) for part in drawn[0]], [Sums.of(part) for part in drawn[1]]


def estimate(means: WeightedMeans) -> Values:
    """Coordinates at which both sides agree; the true ones are 0."""
    return np.asarray(-np.linalg.solve(means.slopes, means.deviations))


def test_the_bias_of_weights_from_the_same_pulses_is_taken_off() -> None:
    found, left = [], []
    for seed in range(100):
        both = Parts(*sides(seed), PARTS * IN_PART / 2)
        found.append(estimate(both.whole))
        free = np.full(2, np.nan)
        left.append(found[-1] - jackknife_bias([both], np.zeros(2), WIDE, free))
    errors = np.std(found, axis=0) / np.sqrt(len(found))
    before, after = np.mean(found, axis=0), np.mean(left, axis=0)
    assert np.abs(before[0]) > 5 * errors[0]
    assert np.abs(after[0]) < 0.3 * np.abs(before[0])
    # not at the cost of much larger errors
    assert (np.std(left, axis=0) < 1.2 * np.std(found, axis=0)).all()


def test_weights_are_of_all_parts_or_all_but_one() -> None:
    simulated, measured = sides(1)
    both = Parts(simulated, measured, 200)
    rest = WeightedMeans(
        sum(simulated[1:], Sums()), sum(measured[1:], Sums()), 200 * (1 - 1 / PARTS)
    )
    np.testing.assert_allclose(both.without[0].weights, rest.weights)
    np.testing.assert_allclose(both.without[0].deviations, rest.deviations)
    everything = WeightedMeans(sum(simulated, Sums()), sum(measured, Sums()), 200)
    np.testing.assert_allclose(both.whole.slopes, everything.slopes)
    assert len(both.without) == PARTS
