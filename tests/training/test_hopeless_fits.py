"""Which searches a poor fit goes through, and what ends it early."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from cpunet.recipes import load_recipe
from cpunet.training import response_fit

SEARCHES = ["_checked", "free_decay_if_better", "ringing_if_better"]
PHYSICS = "_with_wrong_physics"


@pytest.mark.parametrize(
    ("chi_square", "onset_is_off", "expected"),
    [
        (1.01, True, [PHYSICS]),
        (1.01, False, [*SEARCHES, "_refined"]),
        (0.99, True, [*SEARCHES, PHYSICS]),
    ],
)
def test_nothing_else_is_tried_for_another_detector(
    monkeypatch, chi_square, onset_is_off, expected
):
    """If the onset is off, too; `chi_square` is in units of `response_fit.ANOTHER_DETECTOR`."""
    called: list[str] = []
    problem = SimpleNamespace(moments=20, response=SimpleNamespace(config=None))
    found = SimpleNamespace(cost=20 * chi_square * response_fit.ANOTHER_DETECTOR)

    def replace(name: str, result: Any) -> None:
        monkeypatch.setattr(response_fit, name, lambda *_, **__: called.append(name) or result)

    for name in SEARCHES:
        replace(name, (problem, found))
    for name in (PHYSICS, "_refined"):
        replace(name, name)
    asked = {
        "PulseSets": SimpleNamespace(bands=lambda _most=None: []),
        "ElectronicsResponse": None,
        "ResponseProblem": None,
        "best_start": (problem, found),
        "is_poor": True,
        "_onset_is_off": onset_is_off,
    }
    for name, answer in asked.items():
        monkeypatch.setattr(response_fit, name, lambda *_, answer=answer, **__: answer)
    noise = SimpleNamespace(dt_ns=16.0)
    _, fit = response_fit.fit_response(None, None, noise, load_recipe("fast"), seed=0)
    assert called == expected
    assert fit == expected[-1]
