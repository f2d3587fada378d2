"""Slew rate of a stand, from a line and a continuum."""

from __future__ import annotations

import pytest

import cpunet


@pytest.mark.slow
@pytest.mark.parametrize("slew", [11.0, None])
def test_a_slew_rate_is_found_where_there_is_one(tmp_path, slew) -> None:
    settings = [] if slew is None else [f"slew_kev_per_ns={slew}"]
    stand = cpunet.make_stand(
        tmp_path / "stand", events={"FEP": 1500, "1000-1580": 2500}, settings=settings, seed=41
    )
    run = cpunet.train(stand.sim, stand.data, tmp_path / "run", peak="FEP,1000-1580")
    assert run.ok
    found = run.parameters.get("slew_kev_per_ns")
    assert found == (None if slew is None else pytest.approx(slew, rel=0.1))
