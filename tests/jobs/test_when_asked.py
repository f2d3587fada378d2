"""A mapping whose values are made when asked for."""

import pytest

from cpunet.jobs.validation.when_asked import WhenAsked


def test_values_are_made_anew_when_asked_for():
    made = []
    values = WhenAsked({"a": lambda: made.append("a") or 1, "b": lambda: made.append("b") or 2})
    assert "b" in values
    assert list(values) == ["a", "b"]
    assert len(values) == 2
    assert made == []
    assert values["b"] + values["b"] == 4
    assert made == ["b", "b"]
    with pytest.raises(KeyError):
        values["c"]
