"""Errors of numbers that follow from several parameters."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes import load_recipe
from cpunet.training.chain_description import propagated

RESPONSE = ElectronicsResponse(
    load_recipe("fast", ["generator.slow_ns=[400]", "generator.fast_decays_us=[]"]).matching[0],
    16.0,
)


def numbers(response: ElectronicsResponse) -> dict[str, float]:
    first, second = response.log_poles_ns.tolist()
    return {"sum": first + second, "difference": first - second}


def test_what_is_known_together_has_a_small_error() -> None:
    covariance = np.diag([0.04, 0.04, 1.0, 1.0])
    covariance[0, 1] = covariance[1, 0] = -0.0399
    found = propagated(RESPONSE, covariance.tolist(), numbers)
    assert found["sum"] == pytest.approx(np.sqrt(2e-4))
    assert found["difference"] == pytest.approx(np.sqrt(0.08 + 2 * 0.0399))


def test_a_number_that_is_not_always_defined_has_no_error() -> None:
    """Along the other axes its error would be too small."""

    def partly(response: ElectronicsResponse) -> dict[str, float]:
        found = numbers(response)
        return found if response.slow_weights.item() > -0.1 else {"sum": found["sum"]}

    found = propagated(RESPONSE, np.diag([0.04, 0.04, 1.0, 1.0]).tolist(), partly)
    assert list(found) == ["sum"]


@pytest.mark.parametrize(
    "covariance", [[], [[1.0]], [[1.0], [1.0, 2.0]], np.full((4, 4), np.nan).tolist()]
)
def test_without_a_covariance_there_are_no_errors(covariance: list[list[float]]) -> None:
    assert propagated(RESPONSE, covariance, numbers) == {}


def test_the_response_is_left_as_it_is() -> None:
    before = RESPONSE.log_poles_ns.detach().clone()
    propagated(RESPONSE, np.eye(4).tolist(), numbers)
    assert (RESPONSE.log_poles_ns == before).all()
