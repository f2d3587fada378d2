"""A judge that has won or lost is told; one that argues is not."""

from __future__ import annotations

import pytest

from cpunet.training.loop import judges_noted, train


def records(*of_data: float) -> list:
    return [
        {"iteration": i, "rate": 1.0, "losses": {}, "accuracy": {"data": a, "sim": 0.7}}
        for i, a in enumerate(of_data)
    ]


@pytest.mark.parametrize(
    ("early", "late", "told"), [(0.7, 0.99, "won"), (0.7, 0.4, "lost"), (0.99, 0.7, None)]
)
def test_what_counts_is_the_end(early, late, told):
    lines = judges_noted(records(*[early] * 300, *[late] * 100))
    if told is None:
        assert lines == []
    else:
        (line,) = lines
        assert line.startswith(f"the judge of data has {told}: it is right {100 * late:.0f} %")
        assert "\n" not in line


def test_few_updates_tell_nothing():
    assert judges_noted(records(*[1.0] * 10)) == []
    assert judges_noted([{"iteration": 0, "rate": 1.0, "losses": {}}]) == []


def test_accuracies_are_logged_where_the_judges_are_updated(tiny, sets):
    told = []
    recipe = tiny("training.iterations=4", "training.discriminator_interval=2")
    train(*sets, recipe, seed=0, listener=told.extend)
    assert ["accuracy" in record for record in told] == [True, False, True, False]
    assert all(0 <= a <= 1 for a in told[0]["accuracy"].values())
    assert set(told[0]["accuracy"]) == {"data", "sim"}
