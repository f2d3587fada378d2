"""Reports side by side: the best is marked, unlike data are noted, some missing or damaged."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
from scipy.stats import norm

from cpunet.cli import run
from cpunet.errors import CpunetError
from cpunet.validation.compare import Comparison, compare
from cpunet.validation.metrics import Metrics
from cpunet.validation.report import Report

NAMES = ("drift_time", "current_amplitude", "tail_slope", "rise_time")
DEFECTS = {
    "no-json": (b"{", "damaged"),
    "no-text": (b"\xff\xfe\xff", "damaged"),
    "a-list": (b"[1]", "damaged (no mapping)"),
    "no-peaks": (b'{"peaks": 3}', "holds no scores by peak"),
}


def scores(*ious: float, auc: float = 0.52, off: float = 1.0) -> dict[str, Any]:
    """Scores of as many parameters as there are IoU."""
    parameters = {
        name: {
            "iou": {"ren": iou, "rc": 3.0, "ceiling": 88.0},
            "iou_std": {"ren": 2.5, "rc": 1.0, "ceiling": 1.5},
            "p": {"ren": float(2 * norm.sf(88.0 - iou))},
        }
        for name, iou in zip(NAMES, ious or (80.0,), strict=False)
    }
    tested = {"auc": auc, "auc_std": 0.02, "null_mean": 0.5, "null_std": 0.02}
    tested |= dict.fromkeys(("n_data", "n_sim", "missing_data", "missing_sim"), 0)
    return {
        "peaks": {
            "SEP": {
                "n_data": 900,
                "n_sim": 950,
                "parameters": parameters,
                "two_sample": {"ren": tested, "rc": tested},
                "paired": {"ren": {"edge_rmse": 0.0006}, "rc": {"edge_rmse": 0.007}},
            }
        },
        "ae_survival": {"SEP": {"difference": {"ren": off}, "difference_std": {"ren": 2.0}}},
        "rejections": {"data": {"saturated": 3}, "sim": {}},
        "compared": {"trained": "recipe fast on FEP"},
    }


def of(**runs: dict[str, Any]) -> Comparison:
    reports = {name: Report(Metrics(**content)) for name, content in runs.items()}
    return Comparison("ren", reports)


def test_rows_and_what_they_show():
    table = of(a=scores(), b=scores(85.0, auc=0.45, off=-0.5))
    assert [(row.peak, row.score.split(":")[0].split(" [")[0]) for row in table.rows] == [
        ("SEP", "drift time"),
        ("SEP", "classifier"),
        ("SEP", "edge RMSE"),
        ("SEP", "A/E survival minus data"),
    ]
    shown = [row.texts for row in table.rows]
    assert shown == [
        ["80.0 ± 2.5 (88.0)", "85.0 ± 2.5 (88.0)*"],
        ["0.520 ± 0.020*", "0.450 ± 0.020"],  # the first is closer to chance
        ["0.600*", "0.600*"],
        ["+1.0 ± 2.0", "−0.5 ± 2.0*"],
    ]
    assert table.note == ""
    assert table.scores.loc["SEP", "edge RMSE [10⁻³]"].tolist() == [0.6, 0.6]


def test_a_run_far_from_all_others_is_shaded(tmp_path):
    runs = {f"ch{i}": scores(iou) for i, iou in enumerate((80.0, 81.0, 80.5, 79.0, 82.0, 60.0))}
    far = {row.score: row.far for row in of(**runs).rows}
    assert far.pop("drift time: IoU [%] (data vs data)") == [False] * 5 + [True]
    assert not any(far["classifier: AUC"])
    page = table_page(tmp_path, runs)
    assert '<td class="off">60.0 ± 2.5 (88.0)</td>' in page
    assert '<td class="off">79.0' not in page
    few = of(**{name: runs[name] for name in ("ch0", "ch1", "ch5")})
    assert not any(any(row.far) for row in few.rows)  # among three none is an outlier


def test_what_a_run_lacks_is_a_dash():
    old = scores()
    sep = old["peaks"]["SEP"]
    del sep["two_sample"], sep["paired"], old["ae_survival"]
    sep["parameters"]["drift_time"]["iou"].pop("ceiling")
    sep["parameters"]["drift_time"].pop("iou_std")
    table = of(old=old, new=scores())
    assert [row.texts[0] for row in table.rows] == ["80*", "–", "–", "–"]
    assert [row.texts[1].endswith("*") for row in table.rows] == [True] + [False] * 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m["peaks"]["SEP"].update(n_data=901), "numbers of measured pulses"),
        (lambda m: m["peaks"]["SEP"].update(n_sim=1), "numbers of simulated pulses"),
        (lambda m: m["rejections"]["data"].update(saturated=4), "rejections of measured"),
        (lambda m: m["rejections"].pop("sim"), "rejections of simulated"),
        (lambda m: m["peaks"].update(DEP={}), "peaks"),
        (lambda m: m.update(compared={"detector": "V01"}), "detectors"),
    ],
)
def test_other_data_are_noted(change, words):
    other = copy.deepcopy(scores())
    change(other)
    note = of(a=scores(), b=other, c=scores()).note
    assert note.startswith("b: other pulses than those of a (")
    assert words in note


def test_a_method_that_nobody_scored_names_those_there_are():
    one = Report(Metrics(**scores() | {"compared": {"run": "a"}}))
    with pytest.raises(CpunetError, match=r"^a: no score of the method xx; there are ren, rc$"):
        compare(one, method="xx")
    with pytest.raises(CpunetError, match="nothing is scored there"):
        compare(Report(Metrics(compared={"run": "a"}, peaks={})))


def table_page(folder: Path, runs: dict[str, Any]) -> str:
    of(**runs).save(folder / "page.html")
    return (folder / "page.html").read_text("utf-8")


def test_scores_scatter_over_runs(tmp_path):
    runs = {"0": scores(80.0), "1": scores(84.0), "2": scores(81.0)}
    del runs["2"]["peaks"]["SEP"]["two_sample"]
    over = ["81.0 ± 2.1", "0.52 ± 0", "0.6 ± 0", "1 ± 0"]
    assert [row.over for row in of(**runs).rows] == over
    assert "<td>median ± std</td><td>81.0 ± 2.1</td>" in table_page(tmp_path, runs)


def test_the_page_is_whole_and_alone(tmp_path):
    name = 'a<b>&"$\\c$"'
    page = table_page(tmp_path, {name: scores(), "other": scores(85.0)})
    assert "<b>&" not in page
    assert re.search(r"https?:|src=|href=\"[^#]|url\([^#]|<script", page) is None
    assert "<td><b>85.0 ± 2.5 (88.0)</b></td>" in page
    assert "<td>80.0 ± 2.5 (88.0)</td>" in page


def report(folder: Path, *ious: float) -> Path:
    """A report with these IoU."""
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(scores(*ious)))
    (folder / "report.html").write_text("<p>here</p>")
    return folder


def test_every_report_is_linked_and_what_is_off_is_counted(tmp_path):
    # three of four lie beyond three sigma, AUC and survival do not
    runs = {
        "V01/p03": (87.0, 84.0, 70.0, 60.0),
        "V01/p04": (87.0, 85.5),
        "B 2#?<&/p04": (50.0,),
    }
    folders = [report(tmp_path / name / "report", *ious) for name, ious in runs.items()]
    compare(*folders, tmp_path / "V01/p05/report", out=tmp_path / "pages" / "index.html")
    page = (tmp_path / "pages" / "index.html").read_text("utf-8")
    assert "<strong>No report:</strong> V01/p05." in page
    assert "3 of 4 reports" in page
    assert '<td class="off">3 of 6 off</td>' in page
    assert "<td>0 of 4 off</td>" in page
    assert "drift time off by 37.1 sigma (p &lt; 1e-12)" in page
    assert "trained: recipe fast on FEP" in page
    links = re.findall(r'href="([^#].*?)"', page)
    targets = {(tmp_path / "pages" / unquote(link)).resolve() for link in links}
    assert targets == {tmp_path / name / "report" / "report.html" for name in runs}
    assert "B 2#?&lt;&amp;/p04" in page


@pytest.fixture
def two(tmp_path) -> list[Path]:
    return [report(tmp_path / "first", 80.0), report(tmp_path / "second", 85.0)]


def test_reports_have_the_names_of_their_folders(two, tmp_path):
    run = scores(70.0) | {"compared": {"run": "new"}}
    made = compare(Report(Metrics(**run), {}), two[0])
    assert str(made).splitlines()[1].split() == ["peak", "score", "new", "first"]
    a, b, _ = (report(tmp_path / run / "report", 80.0) for run in ("a", "b", "demo"))
    assert [*compare(tmp_path / "demo", two[0] / "metrics.json").reports] == ["demo", "first"]
    assert [*compare(a, b).reports] == ["a", "b"]
    assert [*compare(a, a).reports] == ["report (1)", "report (2)"]
    with pytest.raises(CpunetError, match="none of the 1 reports is there"):
        compare(tmp_path / "nothing")


def test_the_command(two, tmp_path, capsys):
    page = tmp_path / "new" / "[bold]compare.html"
    words = ["compare", *map(str, two), "--out", str(page)]
    assert run(words) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(page)
    assert [path.name for path in page.parent.iterdir()] == [page.name]
    first = page.read_text()
    assert "<b>85.0 ± 2.5 (88.0)</b>" in first
    with pytest.raises(CpunetError, match="exists already"):
        run(words)
    assert run([*words, "--method", "ren", "--force"]) == 0
    assert page.read_text() == first
    assert run(["compare", words[1], str(tmp_path / "none")]) == 0
    assert "no report: none" in capsys.readouterr().out
    with pytest.raises(CpunetError, match="is a folder; give the name of a page"):
        compare(*two, out=page.parent, force=True)


@pytest.mark.parametrize("defect", DEFECTS)
def test_bad_metrics_are_told(two, tmp_path, defect):
    content, words = DEFECTS[defect]
    bad = two[1] / "metrics.json"
    bad.write_bytes(content)
    with pytest.raises(CpunetError, match=re.escape(f"{bad}: {words}")):
        compare(*two, out=tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()
