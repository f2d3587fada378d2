"""The report's files: strict JSON, a page that stands alone, honest gaps."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

from cpunet.analysis.comparisons import compare
from cpunet.analysis.report import write_report
from cpunet.recipes.schema import ScoreConfig

SCORES = ScoreConfig(max_bins=49, bootstraps=10, drift_start_fraction=0.01, edge_samples=100)
VOID = {"meta", "img", "link", "br"}


class Checker(HTMLParser):
    """Collects the addresses a page refers to, and checks that its tags close."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.addresses += [v for k, v in attrs if k in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def figure() -> Figure:
    drawn = Figure(figsize=(2, 1))
    drawn.subplots().plot([0, 1], [0, 1])
    return drawn


def metrics() -> dict:
    rng = np.random.default_rng(0)
    values = {m: {"drift_time": rng.normal(1000, 10, 200)} for m in ("data", "raw", "ren")}
    data = values.pop("data")
    return {
        "peaks": {
            "SEP": {
                "n_sim": 200,
                "n_data": np.int64(200),
                "parameters": compare(data, values, SCORES, seed=1),
                "paired": {
                    "raw": {"rmse": 0.1, "edge_rmse": 0.08, "unaligned": 0},
                    "ren": {"rmse": np.float32(0.25), "edge_rmse": np.nan, "unaligned": 1},
                },
            },
            "DEP": {"n_sim": 0, "n_data": 0, "parameters": {}},
        },
        "training": {"recipe": "paper", "seconds": 12.5, "device": "cpu"},
        "rejections": {"data": {"saturated": 3}, "simulation": {"no <edge>": 4}},
    }


@pytest.fixture
def report(tmp_path):
    drawn = {"SEP_drift_time": figure(), "Co-60/1 losses": figure()}
    write_report(tmp_path, metrics(), drawn, ["Trained on FEP; 1 < 2 & 3."])
    return tmp_path


def test_files_of_the_report(report):
    assert sorted(p.name for p in report.iterdir()) == [
        "Co-60_1_losses.png",
        "SEP_drift_time.png",
        "metrics.json",
        "report.html",
    ]


def test_metrics_are_strict_sorted_json(report):
    def refuse(constant):
        raise AssertionError(constant)

    text = (report / "metrics.json").read_text()
    read = json.loads(text, parse_constant=refuse)
    assert text == json.dumps(read, indent=2, sort_keys=True) + "\n"
    paired = read["peaks"]["SEP"]["paired"]["ren"]
    assert paired == {"rmse": 0.25, "edge_rmse": None, "unaligned": 1}
    assert read["peaks"]["SEP"]["parameters"]["drift_time"]["iou"]["ceiling"] > 50


def test_page_stands_alone(report):
    html = (report / "report.html").read_text()
    own = re.sub(r"base64,[^\"]*", "", html)
    assert not re.search(r"https?:|//[a-z]|url\(|@import|<script", own)
    checker = Checker()
    checker.feed(html)
    assert checker.open == []
    assert len(checker.addresses) == 2
    png = (report / "SEP_drift_time.png").read_bytes()
    embedded = [
        base64.b64decode(a.removeprefix("data:image/png;base64,")) for a in checker.addresses
    ]
    assert png in embedded


def test_page_shows_scores_counts_and_provenance(report):
    html = (report / "report.html").read_text()
    for text in (
        "SEP: 200 simulated, 200 measured pulses",
        '<th scope="col">IoU [%]</th>',
        ">Ceiling</td>",
        "Drift time",
        "<td>REN translation</td><td>0.25</td><td>–</td>",
        "<td>data: saturated</td><td>3</td>",
        "simulation: no &lt;edge&gt;",
        "1 &lt; 2 &amp; 3.",
        "<td>device</td><td>cpu</td>",
    ):
        assert text in html


def test_names_of_methods_are_aligned_as_words(report):
    html = (report / "report.html").read_text()
    left = re.findall(r'<t[hd][^>]*style="text-align: left">([^<]*)</t[hd]>', html)
    filled, empty = ["Method", "Simulation", "REN translation", "Ceiling"], ["Method"]
    assert left == [*filled, *empty]


def test_a_report_of_nothing_can_be_written(tmp_path):
    write_report(tmp_path, {}, {}, [])
    assert json.loads((tmp_path / "metrics.json").read_text()) == {}
    assert "None recorded." in (tmp_path / "report.html").read_text()


def test_the_same_report_gives_the_same_bytes(report, tmp_path_factory):
    again = tmp_path_factory.mktemp("again")
    drawn = {"SEP_drift_time": figure(), "Co-60/1 losses": figure()}
    write_report(again, metrics(), drawn, ["Trained on FEP; 1 < 2 & 3."])
    for path in report.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes()


def test_pulses_that_cannot_be_prepared_are_counted_on_the_page(tmp_path):
    peaks = {"SEP": {"n_sim": 9, "n_data": 9, "parameters": {}, "not_prepared": {"ren": 7}}}
    write_report(tmp_path, {"peaks": peaks}, {}, [])
    assert "REN translation: 7." in (tmp_path / "report.html").read_text()
