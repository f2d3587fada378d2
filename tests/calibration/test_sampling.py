"""Fits to a finite number of simulated events, many times over."""

import numpy as np
import pytest

from cpunet.calibration.sampling import of_parts, of_weights

EVENTS, FUNCTIONS, PARTS, TRUE = 240, 60, 8, 0.3


def estimate(rng: np.random.Generator) -> tuple[float, float, float, float]:
    """One parameter, and its error: of least squares, and without sampling noise.

    The functions of a simulated event spread more with a larger parameter, so that the noise
    of deviations and derivatives goes together; the effect on their means is weak.
    """
    effect = np.full(FUNCTIONS, 0.03)  # on the mean of a function, of a spread of 1
    data = rng.normal(TRUE * effect, 1.0, (EVENTS, FUNCTIONS)).mean(axis=0)
    noise = rng.normal(size=(EVENTS, FUNCTIONS))
    sigma = np.sqrt(2 / EVENTS)
    others = 0.25 * (0.4 * noise + 0.9 * rng.normal(size=noise.shape))
    slope, deviation = (effect + others) / sigma, (noise - data) / sigma
    jacobian = slope.mean(axis=0)
    information = float(jacobian @ jacobian)
    plain = -float(jacobian @ deviation.mean(axis=0)) / information
    deviation += plain * slope
    parts = [x.reshape(PARTS, -1, FUNCTIONS).mean(axis=1) for x in (slope, deviation)]
    move, covariance = of_parts(jacobian[:, np.newaxis], parts[0][:, :, np.newaxis], parts[1])
    return plain, information**-0.5, plain + float(move[0]), float(covariance[0, 0]) ** 0.5


def test_a_fit_without_sampling_noise_has_no_bias_and_errors_that_repeat():
    plain, claimed, fitted, error = np.transpose(
        [estimate(np.random.default_rng(seed)) for seed in range(200)]
    )
    pulls = (fitted - TRUE) / error
    assert np.mean((plain - TRUE) / claimed) < -1
    assert abs(pulls.mean()) < 0.25
    assert np.std((fitted - TRUE) / claimed) > 1.3
    assert 0.9 < pulls.std() < 1.2


def test_weights_from_few_pulses_make_errors_larger():
    """A mean weighted by the inverse of a covariance that a few pulses gave."""
    rng, n, d, pulls = np.random.default_rng(1), 100, 40, []
    for _ in range(400):
        weights = np.linalg.inv(np.cov(rng.normal(size=(n, d)).T))
        information = float(weights.sum())
        found = float(weights.sum(axis=0) @ rng.normal(size=d)) / information
        pulls.append(found * information**0.5)
    assert np.var(pulls) > 2
    assert 0.8 < np.var(pulls) / of_weights(n, d, 1) < 1.2


def test_what_pulses_do_not_determine_has_the_error_of_its_prior():
    rng = np.random.default_rng(2)
    slopes = np.zeros((PARTS, FUNCTIONS, 2))
    slopes[:, :, 0] = 1 + 0.1 * rng.normal(size=(PARTS, FUNCTIONS))
    priors = np.diag([1e-3, 1 / 0.7])
    deviations = rng.normal(size=(PARTS, FUNCTIONS))
    jacobian = np.concatenate([slopes.mean(axis=0), priors])
    errors = [
        np.sqrt(of_parts(jacobian, slopes, deviations, factor)[1].diagonal())
        for factor in (1.0, 1.44)
    ]
    np.testing.assert_allclose([one[1] for one in errors], 0.7, rtol=1e-9)
    assert errors[1][0] == pytest.approx(1.2 * errors[0][0], rel=1e-3)
