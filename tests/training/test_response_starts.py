"""Where fits start, which searches a poor one goes through, and what ends it early."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cpunet.electronics.drawn_tails import KnownDecay
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes import load_recipe
from cpunet.training import response_fit, response_starts
from cpunet.training.fitter import Fitted, Fitter
from cpunet.training.response_problem import ResponseProblem

SEARCHES = ["_with_more", "free_decay_if_better", "ringing_if_better"]
DRIFT = ["drift_if_better", "drift_if_needed"]
PHYSICS = "_with_wrong_physics"


@pytest.mark.parametrize(
    ("chi_square", "onset_is_off", "expected"),
    [
        (1.01, True, [PHYSICS]),
        (1.01, False, [*SEARCHES, "_determined"]),
        (0.99, True, [*SEARCHES, *DRIFT, PHYSICS]),
    ],
)
def test_nothing_else_is_tried_for_another_detector(
    monkeypatch, chi_square, onset_is_off, expected
):
    """If the onset is off, too; `chi_square` is in units of `response_fit.ANOTHER_DETECTOR`."""
    called: list[str] = []
    problem = SimpleNamespace(moments=20, response=SimpleNamespace(config=None, drift=None))
    cost = 20 * chi_square * response_fit.ANOTHER_DETECTOR
    found = Fitted(cast(ResponseProblem, problem), cost, np.eye(1))

    def replace(name: str, result: Any) -> None:
        monkeypatch.setattr(response_fit, name, lambda *_, **__: called.append(name) or result)

    for name in (*SEARCHES, *DRIFT):
        replace(name, found)
    for name in (PHYSICS, "_determined"):
        replace(name, name)
    asked = {
        "PulseSets": SimpleNamespace(bands=lambda _most=None: []),
        "ElectronicsResponse": None,
        "ResponseProblem": None,
        "best_start": found,
        "onset_is_off": onset_is_off,
    }
    for name, answer in asked.items():
        monkeypatch.setattr(response_fit, name, lambda *_, answer=answer, **__: answer)
    noise = SimpleNamespace(dt_ns=16.0)
    _, fit = response_fit.fit_response(None, None, noise, load_recipe("fast"), seed=0)
    assert called == expected
    assert fit == expected[-1]


@pytest.mark.parametrize(
    ("true_us", "tails", "expected"),
    [
        (300.0, None, 300.0),  # its own decay fits, although tails fall with 100 us
        (101.0, None, 100.0),  # that of the tails does: it is from other data
        (300.0, KnownDecay(50.0, 0.01), 50.0),  # what baselines tell is taken in any case
    ],
)
def test_a_known_response_starts_with_the_main_decay_that_fits(
    monkeypatch, true_us, tails, expected
):
    class Problem:
        """A chi-square that knows the main decay."""

        moments, slope = 1, -16e-3 / 100.0  # the slope of the tails is per sample

        def __init__(self, response: ElectronicsResponse) -> None:
            self.response = response
            self.parameters = SimpleNamespace(vector=lambda: None)

        def of(self, response: ElectronicsResponse) -> Problem:
            return Problem(response)

        def residuals(self, _vector: Any) -> np.ndarray:
            return np.atleast_1d(self.response.log_decay_us.item() - math.log(true_us))

    recipe = load_recipe("fast")
    known = ElectronicsResponse(recipe.matching[0], 16.0)
    known.log_decay_us.data.fill_(math.log(300.0))
    fitter = Fitter(recipe.matching[1], tails)
    monkeypatch.setattr(fitter, "fit", lambda of, **_: Fitted(of, 0.0, np.eye(1)))
    found = response_starts.from_known(Problem(known), known, fitter)
    assert found is not None
    decay_us = math.exp(found.problem.response.log_decay_us.item())
    assert decay_us == pytest.approx(expected)
    assert math.exp(known.log_decay_us.item()) == pytest.approx(300.0)  # it is left alone
