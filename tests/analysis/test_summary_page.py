"""One page over detectors and periods: who is on it, what is off, where the links lead."""

from __future__ import annotations

import json
import math
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from cpunet.analysis.forest_plot import span, ticks
from cpunet.analysis.side_by_side import Cell
from cpunet.analysis.summary_page import Entry, summary_page
from cpunet.cli.main import main
from cpunet.errors import CpunetError
from cpunet.jobs.validation.summary_page import detector_and_period, summarise_reports


def metrics(*ious: float, auc: float = 0.51) -> dict[str, Any]:
    """Scores of as many parameters as there are IoU; their ceiling is 88 ± 2."""
    parameters = {
        f"parameter_{i}": {
            "iou": {"ren": iou, "ceiling": 88.0},
            "iou_std": {"ren": 2.5, "ceiling": 2.0},
        }
        for i, iou in enumerate(ious)
    }
    tested = {"ren": {"auc": auc, "auc_std": 0.02, "null_mean": 0.5, "null_std": 0.02}}
    return {
        "peaks": {"SEP": {"parameters": parameters, "two_sample": tested}},
        "training": {"recipe": "fast", "peak": "FEP", "device": "cpu"},
    }


def report(folder: Path, *ious: float) -> Path:
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(metrics(*ious)))
    (folder / "report.html").write_text("<p>here</p>")
    return folder


def figures(page: str) -> list[ET.Element]:
    return [ET.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)]


@pytest.fixture
def four(tmp_path: Path) -> list[Path]:
    return [
        report(tmp_path / detector / period / "report", iou)
        for detector, period, iou in [
            ("V01", "p03", 87.0),
            ("V01", "p04", 86.0),
            ("B02", "p03", 50.0),
            ("B 02#?<&", "p04", 88.0),
        ]
    ]


def test_overview_counts_what_is_off():
    # three of four IoU lie more than two of the ceiling's sigmas below it, the AUC does not
    page = summary_page([Entry("V01", "p03", metrics(87.0, 83.9, 70.0, 60.0), "a/report.html")])
    assert '<td class="off"><a href="a/report.html">3 of 5 off</a></td>' in page
    page = summary_page([Entry("V01", "p03", metrics(87.0, 84.1))])
    assert "<td>0 of 3 off</td>" in page


def test_overview_has_a_place_for_each_detector_and_period():
    page = summary_page(
        [
            Entry("V01", "p03", metrics(80.0)),
            Entry("B02", "p04", metrics(80.0)),
            Entry("C", "p04"),
        ]
    )
    lines = re.findall(r'<tr><th scope="row">(.*?)</tr>', page)
    assert [line.split("</th>")[0] for line in lines] == ["V01", "B02", "C"]
    assert lines[0].endswith("off</td><td>–</td>")
    assert "<td>–</td><td" in lines[1]
    assert lines[2].endswith('<td>–</td><td class="missing">no report</td>')
    assert "2 of 3 reports" in page
    assert "<strong>No report:</strong> C · p04." in page


def test_dots_are_where_the_scores_are():
    entries = [Entry("V01", "p03", metrics(80.0)), Entry("B02", "p03", metrics(70.0))]
    drawing = figures(summary_page(entries))[0]
    dots = [float(dot.get("cx", "")) for dot in drawing.iter("circle")]
    bars = [
        [float(x) for x in re.findall(r"[MH]([\d.]+)", path.get("d", ""))]
        for path in drawing.iter("path")
        if path.get("stroke") == "#0072B2"
    ]
    per_point = (dots[0] - dots[1]) / 10
    assert per_point > 0
    for dot, (left, right) in zip(dots, bars, strict=True):
        assert right - dot == pytest.approx(2.5 * per_point, abs=0.15)
        assert dot - left == pytest.approx(2.5 * per_point, abs=0.15)
    ceilings = [float(rect.get("width", "")) for rect in drawing.iter("rect")]
    assert ceilings == pytest.approx([4 * per_point] * 2, abs=0.15)


def test_a_missing_score_is_said_in_its_line():
    entries = [Entry("V01", "p03", metrics(80.0, 81.0)), Entry("B02", "p03", metrics(70.0))]
    second = figures(summary_page(entries))[1]
    assert len(list(second.iter("circle"))) == 1
    assert [text.text for text in second.iter("text")].count("no score") == 1
    assert [g.findtext("title") for g in second.iter("g")][1] == "B02 · p03: –"


def test_no_score_at_all_is_an_error():
    with pytest.raises(CpunetError, match="no score of the method ren"):
        summary_page([Entry("V01", "p03", {"peaks": {}})])


@pytest.mark.parametrize(
    "ends",
    [(0.0, 100.0), (-3.0, 3.0), (0.49, 0.52), (1e-9, 2e-9), (0.0, math.nextafter(2000.0, 0))],
)
def test_ticks_are_few_and_inside(ends):
    found = ticks(*ends)
    assert 2 <= len(found) <= 5
    assert all(ends[0] <= tick <= ends[1] for tick in found)


def test_span_of_equal_values_is_not_empty():
    for value in (0.0, 5.0):
        low, high = span([Cell("", value), Cell("", value), Cell()])
        assert low < value < high


def test_links_lead_to_the_reports(four, tmp_path):
    out = tmp_path / "pages" / "index.html"
    entries = summarise_reports(four, out)
    assert [(e.detector, e.period) for e in entries][0::3] == [
        ("V01", "p03"),
        ("B 02#?<&", "p04"),
    ]
    page = out.read_text()
    found = re.findall(r'href="(.*?)"', page)
    targets = {(out.parent / unquote(link)).resolve() for link in found}
    assert targets == {(folder / "report.html").resolve() for folder in four}
    assert not any(sign in link for link in found for sign in " #?<")
    assert "B 02#?&lt;&amp;" in page
    assert "<&" not in page


def test_nothing_is_loaded_from_elsewhere(four, tmp_path):
    out = tmp_path / "index.html"
    summarise_reports(four, out)
    assert not re.search(r"(src=|url\(|https?:|@import)", out.read_text())


def test_verdicts_in_words(four, tmp_path):
    out = tmp_path / "index.html"
    summarise_reports(four, out)
    page = out.read_text()
    assert "off by 19.0 sigma (IoU 50.0 of 88.0)" in page
    assert "recipe fast, trained on FEP, on cpu" in page


def test_folders_name_detector_and_period(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert detector_and_period(Path("V01/p03/report/")) == ("V01", "p03")
    assert detector_and_period(Path("p03/report")) == (tmp_path.name, "p03")
    assert detector_and_period(Path("/")) == ("", "/")


def test_runs_that_record_detector_and_period_need_no_folders(tmp_path):
    """As recorded if all runs do so and no two are the same; else by their folders."""
    reports = [report(tmp_path / name, 87.0) for name in ("a", "b")]
    for folder, detector, period in zip(reports, ("V01", "V01"), ("p03", "p04"), strict=True):
        told = metrics(87.0) | {"compared": {"detector": detector, "period": period}}
        (folder / "metrics.json").write_text(json.dumps(told))
    entries = summarise_reports(reports, tmp_path / "index.html")
    assert [entry.name for entry in entries] == ["V01 · p03", "V01 · p04"]
    told["compared"] |= {"period": "p03"}
    (reports[1] / "metrics.json").write_text(json.dumps(told))
    entries = summarise_reports(reports, tmp_path / "index.html", force=True)
    assert [entry.period for entry in entries] == ["a", "b"]


def call(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[object, str, str]:
    arguments, sys.argv = sys.argv, ["cpunet", "summary", *map(str, words)]
    try:
        with pytest.raises(SystemExit) as stop:
            main()
    finally:
        sys.argv = arguments
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


def test_the_command(capsys, four, tmp_path):
    out = tmp_path / "index.html"
    assert call(capsys, *four, "--out", out) == (0, f"{out}: 4 of 4 reports\n", "")
    code, _, err = call(capsys, *four, "--out", out)
    assert (code, "exists already" in err) == (2, True)
    assert call(capsys, *four, "--out", out, "--force")[0] == 0


def damaged(folder: Path) -> None:
    (folder / "metrics.json").write_text("{")


def removed(folder: Path) -> None:
    (folder / "metrics.json").unlink()


@pytest.mark.parametrize(
    ("defect", "words"),
    [(damaged, "cannot be read"), (removed, "no metrics.json in it")],
)
def test_a_bad_report_is_one_line(
    capsys, four, tmp_path, defect: Callable[[Path], None], words: str
):
    defect(four[1])
    out = tmp_path / "index.html"
    code, printed, err = call(capsys, *four, "--out", out)
    assert (code, printed, out.exists()) == (2, "", False)
    (line,) = err.splitlines()
    assert str(four[1]) in line
    assert words in line


def test_missing_reports_are_listed_if_allowed(capsys, four, tmp_path):
    removed(four[1])
    out = tmp_path / "index.html"
    code, printed, _ = call(capsys, *four, "--out", out, "--missing-ok")
    assert (code, printed) == (0, f"no report: V01 · p04\n{out}: 3 of 4 reports\n")
    assert "<strong>No report:</strong> V01 · p04." in out.read_text()
    for folder in (four[0], *four[2:]):
        removed(folder)
    code, _, err = call(capsys, *four, "--out", out, "--missing-ok", "--force")
    assert code == 2
    assert "none of the 4 reports is there yet" in err


def test_the_same_detector_and_period_twice_is_one_line(capsys, four, tmp_path):
    code, _, err = call(capsys, *four, four[0], "--out", tmp_path / "index.html")
    assert code == 2
    assert "of detector V01 and period p03, as is" in err
    assert len(err.splitlines()) == 1
