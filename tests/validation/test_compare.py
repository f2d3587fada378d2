"""Reports side by side: printed, as a page, with some missing or damaged."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from cpunet.cli import run
from cpunet.errors import CpunetError
from cpunet.validation.compare import compare
from cpunet.validation.report import Report


def metrics(*ious: float) -> dict[str, Any]:
    """Scores of as many parameters as there are IoU; their ceiling is 88 ± 2."""
    parameters = {
        f"parameter_{i}": {
            "iou": {"ren": iou, "ceiling": 88.0},
            "iou_std": {"ren": 2.5, "ceiling": 2.0},
        }
        for i, iou in enumerate(ious)
    }
    tested = {"ren": {"auc": 0.51, "auc_std": 0.02, "null_mean": 0.5, "null_std": 0.02}}
    return {
        "peaks": {"SEP": {"parameters": parameters, "two_sample": tested}},
        "training": {"recipe": "fast", "peak": "FEP", "device": "cpu"},
    }


def page_of(folder: Path, runs: dict[str, tuple[float, ...]], **more: Any) -> str:
    """The page ``pages/index.html`` of reports with these IoU; without one there is none."""
    for name, ious in runs.items():
        (folder / name / "report").mkdir(parents=True)
        if ious:
            text = json.dumps(metrics(*ious))
            (folder / name / "report" / "metrics.json").write_text(text)
            (folder / name / "report" / "report.html").write_text("<p>here</p>")
    out = folder / "pages" / "index.html"
    compare(*(folder / name / "report" for name in runs), out=out, **more)
    return out.read_text("utf-8")


def test_every_report_is_linked_and_what_is_off_is_counted(tmp_path):
    # three of four IoU lie more than two of the ceiling's sigmas below it, the AUC does not
    runs = {
        "V01/p03": (87.0, 83.9, 70.0, 60.0),
        "V01/p04": (87.0, 84.1),
        "B 2#?<&/p04": (50.0,),
    }
    page = page_of(tmp_path, runs)
    assert '<td class="off">3 of 5 off</td>' in page
    assert "<td>0 of 3 off</td>" in page
    assert "off by 19.0 sigma (IoU 50.0 of 88.0)" in page
    assert "recipe fast, trained on FEP, on cpu" in page
    links = re.findall(r'href="([^#].*?)"', page)
    targets = {(tmp_path / "pages" / unquote(link)).resolve() for link in links}
    assert targets == {tmp_path / name / "report" / "report.html" for name in runs}
    assert "B 2#?&lt;&amp;/p04" in page


def test_missing_reports_are_listed_if_allowed(tmp_path):
    runs: dict[str, tuple[float, ...]] = {"V01/p03": (87.0,), "V01/p04": ()}
    with pytest.raises(
        CpunetError, match=r"p04/report: no metrics.json in it; .* `missing_ok`"
    ):
        page_of(tmp_path / "a", runs)
    page = page_of(tmp_path / "b", runs, missing_ok=True)
    assert "<strong>No report:</strong> p04." in page
    assert "1 of 2 reports" in page
    with pytest.raises(CpunetError, match="none of the 1 reports is there yet"):
        page_of(tmp_path / "c", {"V01/p04": ()}, missing_ok=True)


def report(folder: Path, iou: float, **more: int) -> Path:
    folder.mkdir(parents=True)
    content = metrics(iou)
    content["peaks"]["SEP"] |= more
    (folder / "metrics.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def two(tmp_path) -> list[Path]:
    return [report(tmp_path / "first", 80.0), report(tmp_path / "second", 85.0)]


def header(compared: object) -> list[str]:
    return str(compared).splitlines()[1].split()


def test_a_report_in_memory_is_compared(two):
    run = {"compared": {"run": "kept"}} | metrics(70.0)
    assert header(compare(Report(run, {}), two[0])) == ["peak", "score", "kept", "first"]


def test_demo_folders_and_files(two, tmp_path):
    report(tmp_path / "demo" / "report", 70.0)
    made = compare(tmp_path / "demo", two[0] / "metrics.json")
    assert made.table.names == ("demo", "first")


def test_names_are_made_unique(tmp_path):
    folders = [report(tmp_path / run / "report", 80.0) for run in ("a", "b")]
    assert compare(*folders).table.names == ("a", "b")
    assert compare(folders[0], folders[0]).table.names == ("report (1)", "report (2)")


def test_the_command(two, tmp_path, capsys):
    page = tmp_path / "new" / "[bold]compare.html"
    words = ["compare", *map(str, two), "--out", str(page)]
    assert run(words) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(page)
    assert [path.name for path in page.parent.iterdir()] == [page.name]
    first = page.read_text()
    assert "<b>85.0\u00a0±\u00a02.5 (88.0)</b>" in first
    with pytest.raises(CpunetError, match="exists already"):
        run(words)
    assert run([*words, "--method", "ren", "--force"]) == 0
    assert page.read_text() == first
    with pytest.raises(CpunetError, match=r"no metrics.json in it; .*, or --missing-ok"):
        run(["compare", words[1], str(tmp_path)])


DEFECTS = {
    "no-json": (b"{", "damaged"),
    "no-text": (b"\xff\xfe\xff", "damaged"),
    "a-list": (b"[1]", "damaged (no mapping)"),
    "no-peaks": (b'{"peaks": 3}', "holds no scores by peak"),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_bad_metrics_are_told(two, tmp_path, defect):
    content, words = DEFECTS[defect]
    bad = two[1] / "metrics.json"
    bad.write_bytes(content)
    with pytest.raises(CpunetError, match=re.escape(f"{bad}: {words}")):
        compare(*two, out=tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_a_folder_is_no_page(two, tmp_path):
    with pytest.raises(CpunetError, match="is a folder; give the name of a page"):
        compare(*two, out=tmp_path, force=True)
