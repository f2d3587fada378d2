"""When another chain is tried, and when it is kept."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cpunet.calibration import other_chains
from cpunet.calibration.other_chains import NEEDED, decaying_chain, other_chain
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes import load_recipe

RECIPE = load_recipe("fast")
CHAIN, OTHER = (ElectronicsResponse(RECIPE.matching[0], 16.0) for _ in range(2))


def compared(chi_square, chain=CHAIN, after=None):
    """A comparison with a chi-square, and that of another chain."""
    return SimpleNamespace(
        parameters=SimpleNamespace(
            chain=SimpleNamespace(response=chain), vector=lambda: np.empty(0)
        ),
        chi_square=lambda vector: chi_square,
        by_chance=(100.0, 10.0),
        of_chain=lambda chain: compared(after, chain),
    )


@pytest.fixture
def decay_free(monkeypatch):
    """Stubs of the fits; what they are called with."""
    called = []

    def fit(plain, fitter):
        called.append(fitter.decay)
        return SimpleNamespace(problem=SimpleNamespace(response=OTHER))

    monkeypatch.setattr(other_chains, "_at_these_physics", lambda *_: None)
    monkeypatch.setattr(other_chains, "with_free_decay", fit)
    monkeypatch.setattr(other_chains, "levenberg_marquardt", lambda *_, **__: None)
    return called


SETS = SimpleNamespace(tails=SimpleNamespace(known_decay="that of the tails"))


def test_what_chance_may_leave_needs_no_other_chain(decay_free):
    assert decaying_chain(compared(139.0), SETS, RECIPE.matching[1]) is None
    assert not decay_free


@pytest.mark.parametrize(("fall", "kept"), [(NEEDED - 1, False), (NEEDED + 1, True)])
def test_a_decay_of_free_time_is_kept_if_chi_square_falls(decay_free, fall, kept):
    found = decaying_chain(compared(141.0, after=141.0 - fall), SETS, RECIPE.matching[1])
    assert found is (OTHER if kept else None)
    assert decay_free == ["that of the tails"]


def test_each_kind_of_chain_is_tried_in_its_round_and_at_the_end():
    tried = []

    def never(problem, sets, training):
        tried.append("never")

    def ever(problem, sets, training):
        tried.append("ever")
        return OTHER

    kinds = {never: 1, ever: 2}

    def other(number, *, settled=False):
        tried.clear()
        found = other_chain(None, SETS, None, kinds, number, settled=settled)
        return found, tried.copy()

    assert other(1) == (None, ["never"])
    assert other(2) == (OTHER, ["ever"])
    assert other(3) == (None, [])
    assert other(4, settled=True) == (None, ["never"])
    assert not kinds
