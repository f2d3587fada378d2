"""Functions in slices of drift time, on readings made by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cpunet.calibration.sliced_functions import (
    AMPLITUDES,
    DENSITY,
    FEW,
    SLICES,
    SlicedFunctions,
)
from cpunet.training.moments import Readings

# Two stretches, three components of which the first is the drift time, the tail slope.
NAMES = ("early", "late", "component 1", "component 2", "component 3", "tail slope")
DRIFT, FURTHER = 2, (3, 4)
CONFIG = SimpleNamespace(segments=(-10, 0, 10), components=3, clip=4.0)


def readings_of(n, seed=0):
    rng = np.random.default_rng(seed)
    linear = rng.normal(size=(n, len(NAMES)))
    linear[:, DRIFT] = rng.uniform(-2, 1, n)  # ends abruptly, as drift times do
    return Readings(linear, rng.normal(-3, 0.1, n), np.ones(n))


def functions_of(n):
    def plain(readings, clip=None):
        limit = clip or CONFIG.clip
        return np.clip(readings.linear, -limit, limit)

    moments = SimpleNamespace(config=CONFIG, data=readings_of(n), names=NAMES, functions=plain)
    return SlicedFunctions(moments)


@pytest.fixture(scope="module")
def functions():
    return functions_of(FEW)


def values_of(functions, readings, words, clip=None):
    """Values of the functions with these words in their names."""
    chosen = [i for i, name in enumerate(functions.names) if words in name]
    assert chosen
    return functions(readings, clip)[:, chosen]


def test_each_function_has_a_name(functions):
    readings = readings_of(50, seed=1)
    values = functions(readings)
    assert values.shape == (50, len(functions.names))
    assert len(set(functions.names)) == len(functions.names)
    assert functions.names[: len(NAMES)] == NAMES
    assert np.array_equal(values[:, : len(NAMES)], readings.linear)
    n_sliced = (len(FURTHER) + AMPLITUDES) * SLICES
    assert len(functions.names) == len(NAMES) + DENSITY + n_sliced


def test_slices_multiply_components_and_amplitudes(functions):
    """A pulse at the centre of a slice keeps its component there; far off nothing is left."""
    readings = readings_of(2)
    centre = np.quantile(readings_of(FEW).linear[:, DRIFT], 0.03)  # of the first slice
    readings.linear[:, DRIFT] = centre, centre + 3
    readings.linear[:, FURTHER[0]] = -1.5
    there, far = values_of(functions, readings, "component 2, slice 1")
    assert there[0] == pytest.approx(-1.5)
    assert abs(far[0]) < 1e-9
    sliced = values_of(functions, readings, "current amplitude, bin 3, slice")[0]
    drift_time = values_of(functions, readings, "component 2, slice")[0] / -1.5
    # one bin of the amplitude in all slices is a number times the slices
    assert np.ptp(sliced[:3] / drift_time[:3]) < 1e-12
    assert 0 < sliced[0] / drift_time[0] <= 1


def test_a_wider_clip_widens_the_bins(functions):
    """Far from the data narrow bins would all be empty, and tell no direction."""
    readings = readings_of(1)
    readings.linear[:, DRIFT] = 6.0
    assert values_of(functions, readings, "drift time, bin").max() < 1e-12
    assert values_of(functions, readings, "drift time, bin", clip=64.0).max() > 1e-3


def test_a_block_without_pulses_has_no_rows(functions):
    """Blocks are made of simulated pulses, of which all can be left out."""
    readings, none = readings_of(5), readings_of(0)
    assert functions(none).shape == (0, functions(readings).shape[1])
