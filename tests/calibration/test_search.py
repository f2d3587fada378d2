"""Parts of a search that can be told without one, and the coordinates of the physics."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cpunet.calibration.identifiability import Linear
from cpunet.calibration.nuisances import NUISANCES, Physics, depletion, freedom, named
from cpunet.calibration.search import Search, _relaxed
from cpunet.errors import CpunetError
from cpunet.simulation.fields import solve
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings

PHYSICS = Physics(read_detector("icpc"), SimulationSettings(), NUISANCES)


@given(st.floats(-3, -0.05), st.floats(0.1, 10))
def test_a_search_that_goes_back_and_forth_ends_between(slope, begin):
    """Where each round overshoots in proportion, two rounds are enough."""
    where, last = np.array([begin]), np.zeros(1)
    for _ in range(2):
        last = _relaxed((slope - 1) * where, last)
        where = where + last
    assert abs(where[0]) < 1e-9 * begin
    assert _relaxed(np.array([1.0, -2.0]), np.array([3.0, 0.0])).tolist() == [1.0, -2.0]


@pytest.mark.parametrize(
    "other_charge",
    ["", "impurity_tilt_1e10_per_cm4=0.1", "surface_charge_1e10_per_cm2=0.1"],
)
def test_a_depletion_voltage_tells_the_impurities(tmp_path, monkeypatch, other_charge):
    """Scaled impurities keep their tilt and the surface charge."""
    monkeypatch.setenv("CPUNET_CACHE", str(tmp_path))
    detector = read_detector("ppc", ["grid_mm=0.25", *filter(None, [other_charge])])
    physics = Physics(detector, SimulationSettings(), (named("impurity"), named("tilt")))
    scale, tilt = detector.impurity_scale, detector.impurity_tilt_1e10_per_cm4
    # scale and tilt add up to first order; the voltage is that of a grid
    for factor, more, error_V in ((0.9, 0.0, 3), (1.05, 0.0, 3), (1.1, 0.01, 15)):
        voltage = solve(detector).depletion(factor * scale, tilt + more)
        _, _, priors = freedom("impurity,tilt", [f"depletion_voltage={voltage}+-1"])
        known = depletion(replace(physics, given=priors))
        assert known(np.array([np.log(factor), more]))[0] == pytest.approx(0, abs=error_V)
        assert abs(known(np.zeros(2))[0]) > 50
    assert not len(depletion(physics)(np.zeros(2)))


def test_a_parameter_that_explains_the_pulses_better_takes_the_place_of_another():
    """The first has moved by ten errors; the second acts as the pulses ask for."""
    halves, at = np.zeros((2, 3)), np.array([1.0, 0, 0])
    columns = np.array([[10.0, 9.9, 0.0], [6.0, 0.0, 1.0], [0.0, 0.0, 3.0]])
    search = Search.__new__(Search)
    search.simulator = SimpleNamespace(physics=SimpleNamespace(nuisances=range(3)))
    search._all = [0, 1, 2]
    better, none = (
        Linear(columns, np.array([0.0, size, 0.0]), halves, at, np.full(3, 1e6), 100.0)
        for size in (6.0, 0.0)
    )
    assert search._better(better, [0]) == [1]
    assert search._better(none, [0]) is None


@pytest.mark.parametrize(
    ("bias", "given"),
    [
        (1.005, {}),  # a step of the impurities is 1 %
        (1.2, {"impurity_factor": (1.3, 0.05)}),
        (1.2, {"depletion_voltage": (3000.0, 50.0)}),
    ],
)
def test_a_detector_that_does_not_deplete_within_the_priors_is_refused(bias, given):
    detector = read_detector("ppc", ["grid_mm=0.25"])
    depletes = solve(detector).depletion(detector.impurity_scale)
    biased = detector.model_copy(update={"bias_V": bias * depletes})
    free = named("temperature"), named("impurity")
    physics = Physics(biased, SimulationSettings(), free)
    refusal = r"within the priors it depletes at .* its bias is .*;"
    with pytest.raises(CpunetError, match=refusal):
        depletion(replace(physics, given=given))
    depletion(replace(physics, nuisances=physics.nuisances[:1]))  # as simulated it does


def test_what_is_free_and_what_is_not():
    looked_at, chosen, priors = freedom("", ["impurity = 1.0 ± 0.05"])
    names = [nuisance.name for nuisance in looked_at]
    assert names[:2] == ["temperature_K", "impurity_factor"]
    assert not chosen
    assert "li_thickness_mm" not in names
    assert priors == {"impurity_factor": (1.0, 0.05)}
    with pytest.raises(CpunetError, match=r"impurity_factor can be 0\.001 to 1000"):
        freedom("", ["impurity=-1±0.1"])
    for free in ("", "bias"):
        with pytest.raises(CpunetError, match="li_thickness_mm: it stays as simulated"):
            freedom(free, ["li_thickness=1±0.1"])
    some, chosen, _ = freedom("li_thickness")
    assert chosen
    assert [nuisance.name for nuisance in some] == ["li_thickness_mm"]


@given(st.sampled_from(NUISANCES), st.floats(-0.5, 0.5))
def test_a_value_has_one_coordinate(nuisance, fraction):
    nominal = PHYSICS.nominal(nuisance)
    low, high = nuisance.bounds(nominal)
    coordinate = min(max(fraction * nuisance.prior, low), high)
    value = nuisance.value(nominal, coordinate)
    assert nuisance.lowest <= value <= nuisance.highest
    assert nuisance.coordinate(nominal, value) == pytest.approx(coordinate, abs=1e-9)
    # a slope is the change of the value
    step = nuisance.step
    value = nuisance.value(nominal, step)
    slope = (nuisance.value(nominal, 1.001 * step) - value) / (0.001 * step)
    rel = 0.2 if nuisance.kind == "square" else 0.01
    assert nuisance.slope(value) == pytest.approx(slope, rel=rel)


def test_each_coordinate_reaches_what_it_names():
    assert PHYSICS.at(np.zeros(len(NUISANCES))) == (PHYSICS.detector, PHYSICS.settings)
    before = {**PHYSICS.detector.model_dump(), **PHYSICS.settings.model_dump()}
    for i, nuisance in enumerate(NUISANCES):
        coordinates = np.zeros(len(NUISANCES))
        coordinates[i] = nuisance.step
        detector, settings = PHYSICS.at(coordinates)
        after = {**detector.model_dump(), **settings.model_dump()}
        field = nuisance.field or nuisance.name
        assert after[field] > before[field]
        assert {name for name in after if after[name] != before[name]} == {field}


@given(st.sampled_from(NUISANCES), st.floats(0.5, 2.0), st.floats(0.01, 1.0))
def test_a_given_prior_is_told_as_it_was_given(nuisance, factor, error):
    value = factor * (PHYSICS.nominal(nuisance) or 1.0)
    value = min(max(value, nuisance.lowest), nuisance.highest)
    i = NUISANCES.index(nuisance)
    centres, widths = replace(PHYSICS, given={nuisance.name: (value, error)}).priors()
    assert PHYSICS.in_own_unit(i, centres[i], widths[i]) == pytest.approx((value, error))


def test_what_is_not_possible_is_refused():
    with pytest.raises(CpunetError, match="li_thickness_mm = 5 is impossible"):
        Physics(
            PHYSICS.detector.model_copy(update={"bore_length": 90.0, "li_thickness": 3.0}),
            PHYSICS.settings,
            (named("li_thickness"),),
        ).at(np.array([2.0]))
