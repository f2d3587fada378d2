"""The card of an exported run: scores of reports, whatever is in them."""

from __future__ import annotations

from cpunet.jobs.translation.export import _score_table


def test_parts_of_a_report_that_are_no_scores_are_left_out() -> None:
    peaks = {
        "DEP": 3,
        "SEP": {"parameters": 3},
        "FEP": {"parameters": {"tail_slope": {"iou": {"ren": 80.04, "raw": None}}, "rise": 1}},
    }
    assert _score_table(peaks)[3:] == ["| FEP | tail slope | ren 80.0 |", ""]
