"""Runs beside each other: the best is marked, and unlike data are noted."""

from __future__ import annotations

import copy
import re
from typing import Any

import pytest

from cpunet.errors import CpunetError
from cpunet.validation.score_figure import score_figure
from cpunet.validation.side_by_side import comparison_page, side_by_side


def metrics(iou: float = 80.0, auc: float = 0.52, off: float = 1.0) -> dict[str, Any]:
    def parameter() -> dict[str, Any]:
        return {
            "iou": {"ren": iou, "rc": 3.0, "ceiling": 88.0},
            "iou_std": {"ren": 2.5, "rc": 1.0, "ceiling": 1.5},
        }

    def tested(value: float) -> dict[str, float]:
        return {"auc": value, "auc_std": 0.02, "null_mean": 0.5, "null_std": 0.02}

    return {
        "peaks": {
            "SEP": {
                "n_data": 900,
                "n_sim": 950,
                "parameters": {"drift_time": parameter(), "tail_slope": parameter()},
                "two_sample": {"ren": tested(auc), "rc": tested(0.99)},
                "paired": {"ren": {"edge_rmse": 0.0006}, "rc": {"edge_rmse": 0.007}},
            }
        },
        "ae_survival": {
            "SEP": {"difference": {"ren": off}, "difference_std": {"ren": 2.0}},
        },
        "rejections": {"data": {"saturated": 3}, "sim": {}},
    }


def test_rows_and_what_they_show():
    table = side_by_side({"a": metrics(), "b": metrics(85.0, 0.45, -0.5)})
    assert [(row.peak, row.score.split(":")[0].split(" [")[0]) for row in table.rows] == [
        ("SEP", "drift time"),
        ("SEP", "tail slope"),
        ("SEP", "classifier"),
        ("SEP", "edge RMSE"),
        ("SEP", "A/E survival minus data"),
    ]
    shown = [[cell.text for cell in row.cells] for row in table.rows]
    assert shown[0] == ["80.0 ± 2.5 (88.0)", "85.0 ± 2.5 (88.0)"]
    assert shown[2] == ["0.520 ± 0.020", "0.450 ± 0.020"]
    assert shown[3] == ["0.600", "0.600"]
    assert shown[4] == ["+1.00 ± 2.00", "-0.50 ± 2.00"]
    # an AUC of 0.52 is closer to chance than one of 0.45
    assert [set(row.best) for row in table.rows] == [{1}, {1}, {0}, {0, 1}, {1}]
    assert table.notes == ()


def test_what_a_run_lacks_is_a_dash():
    old = metrics()
    sep = old["peaks"]["SEP"]
    del sep["two_sample"], sep["paired"], old["ae_survival"]
    del sep["parameters"]["tail_slope"]
    sep["parameters"]["drift_time"]["iou"].pop("ceiling")
    sep["parameters"]["drift_time"].pop("iou_std")
    table = side_by_side({"old": old, "new": metrics()})
    assert [row.cells[0].text for row in table.rows] == ["80.0", "–", "–", "–", "–"]
    assert [set(row.best) for row in table.rows] == [{0, 1}, set(), set(), set(), set()]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m["peaks"]["SEP"].update(n_data=901), "number of measured pulses"),
        (lambda m: m["peaks"]["SEP"].update(n_sim=1), "number of simulated pulses"),
        (lambda m: m["rejections"]["data"].update(saturated=4), "rejections of measured"),
        (lambda m: m["rejections"].pop("sim"), "rejections of simulated"),
        (lambda m: m["peaks"].update(DEP={}), "peaks"),
    ],
)
def test_other_data_are_noted(change, words):
    other = copy.deepcopy(metrics())
    change(other)
    notes = side_by_side({"a": metrics(), "b": other, "c": metrics()}).notes
    assert len(notes) == 1
    assert notes[0].startswith("a and b were scored on different pulses (")
    assert words in notes[0]


def test_a_method_that_nobody_scored_names_those_there_are():
    with pytest.raises(
        CpunetError, match=r"^a, b: no score of the method xx; there are ren, rc$"
    ):
        side_by_side({"a": metrics(), "b": metrics()}, method="xx")
    with pytest.raises(CpunetError, match="nothing is scored there"):
        side_by_side({"a": {"peaks": {}}})


def page_of(runs: dict[str, Any]) -> str:
    return comparison_page(side_by_side(runs), runs, {})


def seed(iou: float, **training: Any) -> dict[str, Any]:
    return metrics(iou) | {"training": {"recipe": "fast", "peak": "FEP"} | training}


def test_scores_scatter_over_runs_of_one_recipe():
    runs = {"0": seed(80.0), "1": seed(84.0), "2": seed(81.0), "other": seed(9, recipe="paper")}
    del runs["2"]["peaks"]["SEP"]["two_sample"]
    over = side_by_side(runs).over_runs
    assert over.names == ("3 runs of fast, FEP",)
    assert [row.cells[0].text for row in over.rows] == [
        "81.0 ± 2.1 (80.0 – 84.0)",
        "81.0 ± 2.1 (80.0 – 84.0)",
        "0.520 ± 0.000 (0.520 – 0.520), 1 missing",
        "0.600 ± 0.00 (0.600 – 0.600)",
        "+1.00 ± 0.00 (+1.00 – +1.00)",
    ]
    assert "<td>81.0\u00a0±\u00a02.1 (80.0 – 84.0)</td>" in page_of(runs)
    apart = {"0": seed(80.0), "1": seed(80.0, peak="SEP")}
    assert side_by_side(apart).over_runs is None


def test_the_page_is_whole_and_alone():
    name = 'a<b>&"$\\c$"'
    page = page_of({name: metrics(), "other": metrics(85.0)})
    assert "<b>&" not in page
    assert re.search(r"https?:|src=|href=\"[^#]|url\([^#]|<script", page) is None
    assert "<b>85.0\u00a0±\u00a02.5 (88.0)</b>" in page
    assert "<td>80.0\u00a0±\u00a02.5 (88.0)</td>" in page
    assert page.count("<svg") == 1  # of the peak


def test_dots_and_bars_stand_where_their_scores_are():
    old = metrics()
    del old["peaks"]["SEP"]["two_sample"]
    table = side_by_side({"old": old, "new": metrics(84.0)})
    panels = score_figure(table.rows, table.names).axes[: len(table.rows)]
    first, classifier = panels[0], panels[2]
    assert first.get_xlabel() == "drift time: IoU [%] (ceiling)"
    dots = [container.lines[0].get_xydata().tolist() for container in first.containers[1::2]]
    assert dots == [[[80.0, 0]], [[84.0, 1]]]
    chance = first.patches[0]
    assert (chance.get_x(), chance.get_width()) == (86.5, 3.0)  # 88 ± 1.5
    (bar,) = first.containers[1].lines[2]
    assert bar.get_segments()[0][:, 0].tolist() == [77.5, 82.5]
    assert [text.get_text() for text in classifier.texts] == ["no score"]
    assert [text.get_text() for text in first.get_yticklabels()] == ["old", "new"]
