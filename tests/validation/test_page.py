"""The report's files: strict JSON, a page that stands alone, honest gaps, methods that hide."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

from cpunet.plotting import line, styled
from cpunet.pulses.two_sample import TwoSample
from synthetic import write_report

TESTED = TwoSample(0.52, 0.02, 0.5, 0.02, 200, 200, 0, 0)
COMPARED = {
    "iou": {"raw": 20.0, "ren": 80.0, "ceiling": 85.0},
    "iou_std": {"raw": 2.0, "ren": 2.0, "ceiling": 1.5},
    "wasserstein": {"raw": 90.0, "ren": 12.345},
    "wasserstein_std": {"raw": 3.0, "ren": 1.2},
    "wasserstein_null": 9.0,
    "wasserstein_null_std": 2.1,
    "mean": 300.0,
    "shift": {"ren": 12.0},
    "shift_std": {"ren": 4.0},
    "p": {"ren": 1e-5},
}
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
    return {
        "peaks": {
            "SEP": {
                "n_sim": 200,
                "n_data": 200,
                "parameters": {"drift_time": COMPARED},
                "further": {"rise_10_90": COMPARED},
                "two_sample": {"raw": {"missing": "few pulses"}, "ren": TESTED},
                "paired": {
                    "raw": {"rmse": 0.1, "edge_rmse": 0.08, "unaligned": 0},
                    "ren": {"rmse": np.float32(0.25), "edge_rmse": np.nan, "unaligned": 1},
                },
            },
            "DEP": {"n_sim": 0, "n_data": 0, "parameters": {}, "missing": "no pulses"},
        },
        "training": {"recipe": "paper", "seconds": 12.5, "device": "cpu"},
        "rejections": {"data": {"saturated": 3}, "simulation": {"no <edge>": 4}},
        "tails": {
            "rate_khz": 1.5,
            "rate_error_khz": 0.1,
            "decay_us": 85.0,
            "percent_above": {"50_kev": {"measured": 20.0, "law": 19.0}},
        },
    }


@pytest.fixture
def report(tmp_path):
    drawn = {"SEP_drift_time": figure(), "Co-60/1 losses": figure()}
    write_report(tmp_path, metrics(), drawn, ["Trained on FEP; 1 < 2 & 3."])
    return tmp_path


def test_page_stands_alone(report):
    html = (report / "report.html").read_text()
    assert not re.search(r"https?:|//[a-z]|url\((?!#)|@import", html.replace(" // ", ""))
    assert "default-src 'none'" in html
    checker = Checker()
    checker.feed(html)
    assert checker.open == []
    assert all(address.startswith("#") for address in checker.addresses)
    ids = re.findall(r' id="([^"]*)"', html)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:url\(|xlink:href=")#([^)"]*)', html)) <= set(ids)


def test_page_shows_scores_counts_and_provenance(report):
    html = (report / "report.html").read_text()
    for text in (
        "SEP: 200 simulated, 200 measured pulses",
        '<th scope="col">IoU [%]</th>',
        ">Data vs data</td>",
        "<td>Drift time [ns]</td>",
        "<summary>Further parameters: 1</summary>",
        "<td>REN translation</td><td>250</td><td>–</td>",
        "<td>data: saturated</td><td>3</td>",
        "simulation: no &lt;edge&gt;",
        "1 &lt; 2 &amp; 3.",
        "<td>device</td><td>cpu</td>",
        "pile-up tails, 1.50 ± 0.10 kHz decaying with",
        "20.0 (19.0) above 50 keV.",
    ):
        assert text in html
    for text in (">12.3 ± 1.2<", ">9.0 ± 2.1<"):
        assert html.count(text) == 2


def test_a_page_begins_with_what_was_compared_and_pictures_of_other_peaks(tmp_path):
    compared = {"simulation": "my <sim>.lh5", "fit": "chi-square is 1.1 per moment"}
    trained = ("FEP mean pulse", "FEP,1000-1580 mean pulse")
    first = ("SEP mean pulse", "DEP mean pulse")
    names = ("losses", *trained, *first, "SEP noise", "A over E survival")
    found = metrics() | {"compared": compared, "training": {"peak": "FEP,1000-1580"}}
    write_report(tmp_path, found, {name: figure() for name in names}, [])
    html = (tmp_path / "report.html").read_text()
    places = [
        html.index(text)
        for text in (
            "The fit is chi-square is 1.1",
            *(f'aria-label="{name}: ' for name in first),
            "my &lt;sim&gt;.lh5",
            'id="scores"',
            *(f'aria-label="{name}: ' for name in ("A over E survival", "SEP noise", *trained)),
        )
    ]
    assert places == sorted(places)
    assert all(html.count(f'aria-label="{name}: ') == 1 for name in names)


def test_the_same_report_gives_the_same_bytes_and_metrics_are_strict_json(report, tmp_path):
    again = tmp_path / "again"
    again.mkdir()
    drawn = {"SEP_drift_time": figure(), "Co-60/1 losses": figure()}
    write_report(again, metrics(), drawn, ["Trained on FEP; 1 < 2 & 3."])
    names = "Co-60_1_losses.svg SEP_drift_time.svg metrics.json parameters.npz report.html"
    assert sorted(path.name for path in again.iterdir()) == names.split()
    for path in again.iterdir():
        assert path.read_bytes() == (report / path.name).read_bytes()

    text = (report / "metrics.json").read_text()
    read = json.loads(text, parse_constant=pytest.fail)
    assert text == json.dumps(read, indent=2, ensure_ascii=False) + "\n"
    paired = read["peaks"]["SEP"]["paired"]["ren"]
    assert paired == {"rmse": 0.25, "edge_rmse": None, "unaligned": 1}
    picture = ElementTree.parse(report / "SEP_drift_time.svg").getroot()
    assert picture.tag == "{http://www.w3.org/2000/svg}svg"
    assert (picture.get("width"), picture.get("height")) == ("144pt", "72pt")
    assert "0.5" in [text.text for text in picture.iter("{http://www.w3.org/2000/svg}text")]


def test_nothing_is_empty_and_the_verdict_comes_first(tmp_path):
    parameters = {"tail_slope": COMPARED}
    both = parameters | {"rise_time": COMPARED}
    found = {"training": {"peak": "FEP"}, "peaks": {"SEP": {"further": both}}}
    found["peaks"]["SEP"]["parameters"] = parameters
    write_report(tmp_path, found, {}, [])
    html = (tmp_path / "report.html").read_text()
    headline = (
        "REN is off in 2 of 2 quantities of SEP: SEP T(10–90 %) (p = 1e-05), "
        "SEP tail slope (p = 1e-05)."
    )
    places = [html.index(text) for text in (headline, 'table class="main"', 'id="scores"')]
    assert places == sorted(places)
    assert "<li>REN, SEP: T(10–90 %) off by 4.4 sigma (+12.0 ± 4.0 ns" in html
    row = r"<td>SEP</td><td[^>]*>REN translation</td><td[^>]*>tail slope</td>"
    assert re.search(row + r"<td>\+12\.0 ± 4\.0 1/ms</td><td>1e-05</td>", html)
    assert '<td data-name="REN − data">+12.0 ± 4.0</td><td data-name="p">1e-05</td>' in html
    for name in ("shapes", "noise", "pulses"):
        assert f'id="{name}"' not in html
        assert f'href="#{name}"' not in html
    assert not re.search(r"</h[23]>\s*(</section>|<h2)", html)


def test_survival_by_ranges_and_the_noise_are_tables(tmp_path):
    survived = {"survival": 33.333, "survival_std": 3.47, "peak": 400}
    ranges = {"Qbb": {"data": survived, "ren": {"missing": "there is no cut", "peak": 2}}}
    noise = {"ren": {"n": 90, "samples": 200, "rms": 1e-3, "rms_std": 1e-4, "sigma": -1.5}}
    peaks = {"SEP": {"missing": "no pulses", "noise": noise}}
    found = {"ae_details": {"survival by energy range": ranges}, "peaks": peaks}
    write_report(tmp_path, found, {}, [])
    rows = re.findall(r"<tr>(<td.*?)</tr>", (tmp_path / "report.html").read_text())
    told = [re.findall(r">([^<>]+)</td>", row) for row in rows]
    assert ["Qbb", "Data", "400", "33.3 ± 3.5"] in told
    assert ["REN translation", "2", "–", "there is no cut"] in told  # of the same range
    assert ["SEP", "REN translation", "90", "200", "1.00 ± 0.10", "–", "−1.5", "–"] in told


SELFTEST = """<script>
const shown = (method) => [...document.querySelectorAll(`[data-method="${method}"]`)]
  .map((one) => one.getBoundingClientRect().width > 0);
const button = document.querySelector('[data-hides="ren"]');
const state = () => [shown("ren"), shown("data"), button.ariaPressed];
const press = () => { button.click(); return state(); };
const seen = { before: state(), hidden: press(), again: press() };
seen.widths = [document.documentElement.scrollWidth, innerWidth];
seen.requests = performance.getEntriesByType("resource").length;
const report = document.body.appendChild(document.createElement("pre"));
report.id = "selftest";
report.textContent = JSON.stringify(seen);
</script></body>"""


@styled
def two_methods() -> Figure:
    figure = Figure()
    axes = figure.subplots()
    for method, text in (("data", "Data, n = 3"), ("ren", "REN translation, n = 3")):
        line(axes, [0, 1, 2], [1, 2, len(text)], method, text)
    axes.legend()
    return figure


@pytest.mark.thorough
def test_a_click_hides_a_method_in_all_figures(tmp_path):
    browsers = map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
    browser = next(filter(None, browsers), None) or pytest.skip("no Chromium is installed")
    write_report(tmp_path, {}, {"SEP mean pulse": two_methods(), "SEP lq": two_methods()})
    page = tmp_path / "report.html"
    page.write_text(page.read_text().replace("</body>", SELFTEST))
    switches = (
        "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking "
        "--disable-component-update --disable-dev-shm-usage --enable-logging=stderr "
        "--window-size=500,900 --virtual-time-budget=10000 --dump-dom "
        f"--user-data-dir={tmp_path / 'profile'}"
    ).split()
    words = [browser, *switches, page.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=240, check=False)
    assert "CONSOLE" not in done.stderr
    report = re.search(r'<pre id="selftest"[^>]*>(.*?)</pre>', done.stdout, re.DOTALL)
    assert report, f"the page did not report:\n{done.stdout[-500:]}\n{done.stderr}"
    seen = json.loads(html.unescape(report[1]))
    # a line in each of two figures
    assert seen["before"] == [[True] * 2, [True] * 2, "true"]
    assert seen["hidden"] == [[False] * 2, [True] * 2, "false"]
    assert seen["again"] == seen["before"]
    assert seen["widths"][0] <= seen["widths"][1]
    assert seen["requests"] == 0
