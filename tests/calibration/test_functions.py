"""Functions in slices of drift time."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest

from cpunet.calibration.sliced_functions import SlicedJoint
from cpunet.training.pulse_sets import PulseSets
from synthetic import load_recipe
from unpaired import CHAIN, measured_with

RECIPE = load_recipe("fast")


@pytest.fixture(scope="module")
def functions() -> SlicedJoint:
    (sides,) = PulseSets(*measured_with(CHAIN, 800), RECIPE, np.random.default_rng(0)).sides()
    return SlicedJoint(sides)


def names_of(functions: SlicedJoint) -> list[str]:
    return [*chain.from_iterable(functions.names.values())]


def values_of(functions, words):
    """Values of the functions whose names begin so, for the measured pulses."""
    chosen = [i for i, name in enumerate(names_of(functions)) if name.startswith(words)]
    assert chosen
    return functions.data[:, chosen]


def test_slices_multiply_components_and_amplitudes(functions):
    """All slices are numbers of the drift time times what is sliced."""
    second, third = (
        functions.data[:, names_of(functions).index(f"component {c}")] for c in (2, 3)
    )
    slices = [values_of(functions, f"component {c}, slice") for c in (2, 3)]
    np.testing.assert_allclose(
        slices[0] * third[:, None], slices[1] * second[:, None], atol=1e-9
    )
    some = np.abs(second) > 0.1
    shares = slices[0][some] / second[some, None]
    amplitude = values_of(functions, "current amplitude, bin 3, slice")[some]
    k = shares.argmax(axis=1)[:, None]
    bins = np.take_along_axis(amplitude / shares.clip(1e-12), k, 1)
    np.testing.assert_allclose(amplitude, bins * shares, atol=1e-9)
    assert bins.min() >= 0
    assert bins.max() <= 1


def test_wider_functions_see_pulses_far_from_the_data(functions):
    """Narrow bins would all be empty, and have no derivatives."""
    sides, wide = functions.sides, SlicedJoint(functions.sides, 16.0)
    shape = functions._shape(sides.data)
    shape[:, -1] = 10.0  # drift times in their robust standard deviations
    near, far = (one._sliced(shape, sides.data)[0][0] for one in (functions, wide))
    assert near.max() < 1e-6
    assert far.max() > 1e-2
