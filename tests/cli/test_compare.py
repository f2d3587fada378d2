"""`cpunet compare` on report folders, demo folders and files, good and bad."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest


def metrics(iou: float, n_data: int = 900) -> dict[str, Any]:
    parameter = {
        "iou": {"ren": iou, "raw": 1.0, "ceiling": 88.0},
        "iou_std": {"ren": 2.5, "raw": 0.1, "ceiling": 1.5},
    }
    return {"peaks": {"SEP": {"n_data": n_data, "parameters": {"drift_time": parameter}}}}


def report(folder: Path, iou: float, **more: int) -> Path:
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(metrics(iou, **more)))
    return folder


@pytest.fixture
def two(tmp_path) -> list[Path]:
    return [report(tmp_path / "first", 80.0), report(tmp_path / "second", 85.0)]


def header(out: str) -> list[str]:
    return next(line for line in out.splitlines() if line.strip().startswith("peak")).split()


def test_two_reports(command, two):
    outcome = command("compare", *two)
    assert (outcome.code, outcome.err) == (0, "")
    assert header(outcome.out) == ["peak", "score", "first", "second"]
    assert "80.0 ± 2.5 (88.0)" in outcome.out
    assert "85.0 ± 2.5 (88.0)" in outcome.out
    assert "note" not in outcome.out


def test_another_method(command, two):
    assert "1.0 ± 0.1 (88.0)" in command("compare", *two, "--method", "raw").out


def test_demo_folders_and_files(command, two, tmp_path):
    report(tmp_path / "demo" / "report", 70.0)
    outcome = command("compare", tmp_path / "demo", two[0] / "metrics.json")
    assert header(outcome.out) == ["peak", "score", "demo", "first"]


def test_names_are_made_unique(command, tmp_path):
    folders = [report(tmp_path / run / "report", 80.0) for run in ("a", "b")]
    assert header(command("compare", *folders).out)[2:] == ["a", "b"]
    same = header(command("compare", folders[0], folders[0]).out)
    assert same[2:] == ["report", "(1)", "report", "(2)"]


def test_names_with_brackets_are_shown_as_they_are(command, tmp_path):
    folder = report(tmp_path / "[bold]x[", 80.0)
    assert "[bold]x[" in command("compare", folder).out


def test_different_data_are_noted(command, two, tmp_path):
    other = report(tmp_path / "third", 85.0, n_data=7)
    assert "note: first and third were scored on different pulses" in (
        command("compare", two[0], other).out
    )


def test_the_page(command, two, tmp_path):
    page = tmp_path / "new" / "compare.html"
    outcome = command("compare", *two, "--out", page)
    assert outcome.code == 0
    assert outcome.out.splitlines()[-1] == str(page)
    assert [path.name for path in page.parent.iterdir()] == ["compare.html"]
    first = page.read_text()
    assert first.startswith("<!doctype html>")
    assert "<b>85.0\u00a0±\u00a02.5 (88.0)</b>" in first

    refused = command("compare", *two, "--method", "raw", "--out", page)
    assert refused.code == 2
    assert "exists already" in refused.err
    assert page.read_text() == first
    assert command("compare", *two, "--method", "raw", "--out", page, "--force").code == 0
    assert page.read_text() != first


DEFECTS = {
    "no-json": ("{", "damaged"),
    "no-text": (b"\xff\xfe\xff", "damaged"),
    "a-list": ("[1]", "damaged (no mapping)"),
    "no-peaks": ('{"peaks": 3}', "holds no scores by peak"),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_bad_metrics_are_one_line(command, two, tmp_path, defect):
    content, words = DEFECTS[defect]
    bad = two[1] / "metrics.json"
    bad.write_bytes(content if isinstance(content, bytes) else content.encode())
    outcome = command("compare", *two, "--out", tmp_path / "page.html")
    assert (outcome.code, outcome.out) == (2, "")
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"error: {bad}: {words}")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(
    ("name", "words"),
    [("nothing", "no such folder or file"), ("empty", "no metrics.json in it")],
)
def test_no_report_is_one_line(command, two, tmp_path, name, words):
    (tmp_path / "empty").mkdir()
    outcome = command("compare", two[0], tmp_path / name)
    assert outcome.code == 2
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"error: {tmp_path / name}: {words}; ")


def test_a_folder_is_no_page(command, two, tmp_path):
    outcome = command("compare", *two, "--out", tmp_path, "--force")
    assert outcome.code == 2
    assert "is a folder" in outcome.err


def test_an_unknown_method_is_one_line(command, two):
    outcome = command("compare", *two, "--method", "magic")
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.splitlines() == [
        "error: first, second: no score of the method magic; there are ren, raw"
    ]
