"""The coordinates of a chain in which it is fitted."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.chain_fit import Parabola, SmoothParameters, minimum, vector_of
from synthetic import load_recipe

DT_NS = 16.0


def response(poles_ns: tuple[float, float], slow: float) -> ElectronicsResponse:
    few = ["generator.slow_ns=[400]", "generator.fast_decays_us=[4, 16]"]
    made = ElectronicsResponse(load_recipe("fast", few).matching[0], DT_NS)
    made.log_poles_ns[...] = np.log(poles_ns)
    made.log_decay_us.fill(float(np.log(80.0)))
    made.slow_weights.fill(slow)
    return made


def put(response: ElectronicsResponse, vector: np.ndarray) -> None:
    """Set the parameters themselves."""
    parts = [*response.parameters.values()]
    stops = np.cumsum([len(part) for part in parts])[:-1]
    for part, values in zip(parts, np.split(vector, stops), strict=True):
        part[:] = values


def test_coordinates_are_those_of_poles_and_decays_and_back() -> None:
    made = response((60.0, 40.0), 0.05)
    smooth = SmoothParameters(made)
    decay, vector = smooth.labels.index("log_decay_us"), vector_of(made)
    vector[decay] += np.log(0.8)
    vector[-2:] = 0.05, -0.02
    put(made, vector)
    place = smooth.vector()
    np.testing.assert_allclose(place[0], np.log(2400) / 2)
    np.testing.assert_allclose(place[1], (np.log(1.5) / 2) ** 2)
    assert place[decay] == pytest.approx(0.97 * 0.25)
    smooth.set(place - np.eye(len(place))[1])  # below 0 there are no real poles
    np.testing.assert_allclose(np.exp(made.log_poles_ns), 2400**0.5)
    smooth.set(place)
    np.testing.assert_allclose(vector_of(made), vector, rtol=1e-12)
    # derivatives of the coordinates with the parameters
    slopes = []
    for step in 1e-6 * np.eye(len(vector)):
        put(made, vector + step)
        slopes.append((smooth.vector() - place) / 1e-6)
    put(made, vector)
    np.testing.assert_allclose(smooth.turn().T, slopes, atol=1e-5)
    known = np.diag([1e4, 1e6, 1e4, 1e6, 1e2, 1e5, 1e5])
    by_parameters = np.array(slopes) @ known @ np.transpose(slopes)
    covariance = np.linalg.inv(
        by_parameters + np.diag(SmoothParameters(made, poles=False).widths ** -2.0)
    )
    np.testing.assert_allclose(smooth.covariance(known), covariance, rtol=1e-4, atol=1e-9)


def test_samples_are_no_sharper_than_points_and_no_blunter_than_means() -> None:
    """A step that leads beyond ends at the bound, and the other coordinates make up for it."""
    unknowns = SmoothParameters(response((60.0, 40.0), 0.05))
    at = unknowns.labels.index("sharpness")
    truth = unknowns.vector() + np.eye(len(unknowns.centre))[at]  # 1.5
    rows = 100 * (np.eye(len(truth)) + 0.3)

    def parabola(place: np.ndarray) -> Parabola:
        off = (place - unknowns.centre) / unknowns.widths
        deviation = rows @ (place - truth)
        gradient = rows.T @ deviation + off / unknowns.widths
        cost = float(deviation @ deviation)
        return Parabola(place, cost, 1, rows.T @ rows, cost + float(off @ off), gradient)

    end = minimum(unknowns, parabola, 20, 1e-9, lambda _: None)
    assert end.place[at] == 1.0
    assert abs(parabola(end.place).gradient[np.arange(len(truth)) != at]).max() < 1e-6
