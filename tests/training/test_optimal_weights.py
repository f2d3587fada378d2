"""Optimally weighted functions: what they find, and what they leave alone."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import finish
from cpunet.networks.response_layer import ElectronicsResponse, record_length
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import current_amplitude
from cpunet.recipes import load_recipe
from cpunet.training import optimal_weights
from cpunet.training.diagnosis import amplitude_shift
from cpunet.training.moments import Moments
from cpunet.training.optimal_weights import ConditionalFunctions, refine
from cpunet.training.response_problem import Band, Parameters, ResponseProblem, SmoothParameters
from cpunet.training.translated import Noise, SimulatedSide
from synthetic import drifting, two_sites

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
    made.log_poles_ns.data.copy_(torch.tensor(poles_ns, dtype=torch.float64).log())
    made.log_decay_us.data.fill_(float(np.log(80.0)))
    made.slow_weights.data.fill_(slow)
    return made


def band_behind(poles_ns: tuple[float, float]) -> Band:
    """Pulses behind two poles, and others to be translated."""
    with torch.no_grad():
        records = response(poles_ns, 0.05)(torch.from_numpy(charge(1))).numpy()
    energies = np.full(N, KEV)
    data = finish(
        records, RECIPE.preparation, dt_ns=DT_NS, noise=WHITE, energy_kev=energies, seed=3
    ).windows
    moments = Moments.of_data(data, TRAINING, RECIPE.preparation)
    noise = Noise.draw(WHITE, energies, record_length(800), 2, np.random.default_rng(4))
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
    found = near.parameters.vector()
    assert near.parameters.labels[:3] == ["log_poles_ns", "log_poles_ns", "log_decay_us"]
    assert (np.abs(found - truth) < 4 * errors).all()
    # together the poles are known far better than one by one
    together = np.array([0.6, 0.4, 0, 0])
    assert np.sqrt(together @ covariance @ together) < 0.003
    assert abs(together @ (found - truth)) < 0.01


def test_the_order_of_the_pulses_does_not_matter(band: Band, monkeypatch) -> None:
    """Weights come from some of them, which are spread over the file."""
    monkeypatch.setattr(optimal_weights, "FOR_WEIGHTS", 400)
    steepness = np.diff(band.sim.sim, axis=1).max(axis=1)
    sim = band.sim.of(np.argsort(steepness))
    in_order = replace(band, sim=sim)
    one, other = (ResponseProblem(response((63.0, 39.0), 0.045), [b]) for b in (band, in_order))
    errors, same = (np.sqrt(refine(near, near.bands, 6).diagonal()) for near in (one, other))
    np.testing.assert_allclose(same, errors, rtol=0.1)
    np.testing.assert_array_less(
        np.abs(other.parameters.vector() - one.parameters.vector()), errors
    )


def test_poles_are_told_apart_from_where_they_are_equal(band: Band) -> None:
    """Where they are equal, derivatives with their difference vanish."""
    near = ResponseProblem(response((49.0, 48.9), 0.05), [band])
    refine(near, [band], 6)
    poles = np.sort(near.response.log_poles_ns.detach().exp().numpy())
    np.testing.assert_allclose(poles, [40, 60], atol=6)


def test_equal_poles_are_found_equal_from_where_they_differ() -> None:
    """The best difference may be that of no real poles; the fit ends at the bound."""
    band = band_behind((49.0, 49.0))
    near = ResponseProblem(response((60.0, 40.0), 0.05), [band])
    refine(near, [band], 6)
    poles = near.response.log_poles_ns.detach().exp().numpy()
    assert np.abs(np.diff(poles)).max() < 12
    assert np.sqrt(np.prod(poles)) == pytest.approx(49, abs=0.5)


def test_coordinates_are_those_of_the_poles_and_back() -> None:
    made = response((60.0, 40.0), 0.05)
    smooth = SmoothParameters(Parameters(made))
    place = smooth.get()
    np.testing.assert_allclose(place[0], np.log(2400) / 2)
    np.testing.assert_allclose(place[1], (np.log(1.5) / 2) ** 2)
    smooth.set(place + np.array([0, -1, 0, 0]))  # below 0 there are no real poles
    np.testing.assert_allclose(made.log_poles_ns.detach().exp(), 2400**0.5)
    smooth.set(place)
    np.testing.assert_allclose(made.log_poles_ns.detach().exp(), [60, 40])
    # derivatives of the coordinates with the parameters
    vector = smooth.parameters.vector()
    slopes = smooth.by_parameters(np.eye(4), vector)
    for i in range(4):
        moved = vector.copy()
        moved[i] += 1e-6
        np.testing.assert_allclose((smooth.of(moved) - place) / 1e-6, slopes[:, i], atol=1e-5)


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
    pulses = torch.from_numpy(charge(2))
    with torch.no_grad():
        translated, true = (
            np.log(current_amplitude(response(poles, 0.05)(pulses).numpy()))
            for poles in (poles_ns, (60.0, 40.0))
        )
    shift, error = amplitude_shift(response(poles_ns, 0.05), [band])
    assert shift == pytest.approx((true - translated).mean(), rel=0.05)
    assert 0 < error < 0.01


def test_functions_are_components_in_bins_of_the_amplitude(band: Band) -> None:
    functions = ConditionalFunctions.of(band.moments, 5)
    readings = band.moments.data[slice(0, 7)]
    values = functions(readings)
    bins = len(functions.centres)
    plain = band.moments.functions(readings)
    assert values.shape == (7, plain.shape[1] + bins + bins * TRAINING.components)
    np.testing.assert_array_equal(values[:, : plain.shape[1]], plain)
    weights = values[:, plain.shape[1] : plain.shape[1] + bins]
    first = len(TRAINING.segments) - 1
    products = values[:, plain.shape[1] + bins :].reshape(7, TRAINING.components, bins)
    expected = plain[:, first : first + TRAINING.components, np.newaxis] * weights[:, None]
    np.testing.assert_allclose(products, expected)
    assert (np.diff(functions.centres) > 0).all()
    weighted = replace(readings, weights=np.arange(7.0))
    np.testing.assert_allclose(functions.sum(weighted), np.arange(7.0) @ values)
