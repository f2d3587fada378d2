"""Coordinates of the physics, and what they do to a detector and its settings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpunet.calibration.nuisances import NUISANCES, Physics, named
from cpunet.errors import CpunetError
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings

PHYSICS = Physics(read_detector("icpc"), SimulationSettings(), NUISANCES)


@given(st.sampled_from(NUISANCES), st.floats(-0.5, 0.5))
def test_a_value_has_one_coordinate(nuisance, fraction):
    nominal = PHYSICS.nominal(nuisance)
    low, high = nuisance.bounds(nominal)
    coordinate = min(max(fraction * nuisance.prior, low), high)
    value = nuisance.value(nominal, coordinate)
    assert nuisance.lowest <= value <= nuisance.highest
    assert nuisance.coordinate(nominal, value) == pytest.approx(coordinate, abs=1e-9)


@given(st.sampled_from(NUISANCES))
def test_a_slope_is_the_change_of_the_value(nuisance):
    nominal = PHYSICS.nominal(nuisance)
    at = nuisance.step
    value = nuisance.value(nominal, at)
    change = nuisance.value(nominal, 1.001 * at) - value
    if nuisance.name == "cloud_fwhm_mm":
        assert nuisance.slope(value) == pytest.approx(change / (0.001 * at), rel=0.2)
    else:
        assert nuisance.slope(value) == pytest.approx(change / (0.001 * at), rel=0.01)


def test_nothing_changes_at_zero():
    assert PHYSICS.at(np.zeros(len(NUISANCES))) == (PHYSICS.detector, PHYSICS.settings)


def test_each_coordinate_reaches_what_it_names():
    before = {**PHYSICS.detector.model_dump(), **PHYSICS.settings.model_dump()}
    for i, nuisance in enumerate(NUISANCES):
        coordinates = np.zeros(len(NUISANCES))
        coordinates[i] = nuisance.step
        detector, settings = PHYSICS.at(coordinates)
        after = {**detector.model_dump(), **settings.model_dump()}
        of_factor = "impurity_scale" if nuisance.name == "impurity_factor" else nuisance.name
        field = nuisance.field or of_factor
        assert after[field] > before[field]
        assert {name for name in after if after[name] != before[name]} == {field}


@given(st.sampled_from(NUISANCES), st.floats(0.5, 2.0), st.floats(0.01, 1.0))
def test_a_given_prior_is_told_as_it_was_given(nuisance, factor, error):
    value = factor * (PHYSICS.nominal(nuisance) or 1.0)
    value = min(max(value, nuisance.lowest), nuisance.highest)
    i = NUISANCES.index(nuisance)
    centres, widths = PHYSICS.priors({nuisance.name: (value, error)})
    assert PHYSICS.in_own_unit(i, centres[i], widths[i]) == pytest.approx((value, error))


def test_what_is_not_known_or_possible_is_refused():
    with pytest.raises(CpunetError, match="no such parameter of the physics; these are temp"):
        named("colour")
    with pytest.raises(CpunetError, match="li_thickness_mm = 5 is impossible"):
        Physics(
            PHYSICS.detector.model_copy(update={"bore_length": 90.0, "li_thickness": 3.0}),
            PHYSICS.settings,
            (named("li_thickness"),),
        ).at(np.array([2.0]))
