"""The report's page in a browser: charts can be worked, fit a phone, and ask for nothing."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from cpunet.analysis.report import write_report

HERE = Path(__file__).parent
TRAP = """<script>
window.caught = [];
addEventListener("error", (event) => window.caught.push(String(event.message)));
addEventListener("unhandledrejection", (event) => window.caught.push(String(event.reason)));
console.error = (...words) => window.caught.push(words.join(" "));
</script>"""
# all widths at once: a browser's start is slow
AROUND = """<!doctype html><style>iframe { border: 0; height: 900px }</style>
<iframe src="inner.html" style="width: 1280px"></iframe>
<iframe src="inner.html" style="width: 768px"></iframe>
<iframe src="inner.html" style="width: 400px"></iframe>
<script>
const seen = {};
addEventListener("message", (event) => {
  seen[["1280", "768", "400"].find((_, i) => event.source === frames[i])] = event.data;
  if (Object.keys(seen).length < 3) return;
  const pre = document.createElement("pre");
  pre.id = "selftest";
  pre.textContent = JSON.stringify(seen);
  document.body.append(pre);
});
</script>"""


def neighbour(path: Path) -> ModuleType:
    """Import a module of the tests, which are no package."""
    spec = importlib.util.spec_from_file_location(f"neighbour_{path.stem}", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


synthetic = neighbour(HERE / "synthetic_charts.py")
browser = neighbour(HERE.parent / "browser.py")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    browser.browser()
    found = tmp_path_factory.mktemp("page")
    metrics = {
        "peaks": {
            peak: {"n_sim": 300, "n_data": 300, "parameters": scores}
            for peak, scores in synthetic.scores_of(synthetic.values_of()).items()
        },
        "verdicts": {"summary": ["REN, SEP: </script><b>all</b> agree"]},
        "noise": {m: {f"band {i}": 0.1 for i in range(20)} for m in ("data", "ren")},
    }
    write_report(found, metrics, {}, ["A note."], synthetic.views_of())
    html = (found / "report.html").read_text()
    inner = html.replace("<head>", f"<head>{TRAP}", 1)
    selftest = (HERE / "page_selftest.js").read_text()
    inner = inner.replace("</body>", f"<script>{selftest}</script></body>")
    (found / "inner.html").write_text(inner)
    (found / "around.html").write_text(AROUND)
    return found


@pytest.fixture(scope="module")
def report(folder: Path) -> dict[str, dict[str, Any]]:
    seen, log = browser.run_page(folder / "around.html", width=2600)
    for found in seen.values():
        assert "failed" not in found, found
    spoken = [line for line in log.splitlines() if "CONSOLE" in line]
    # but for the request that the test itself tries to make
    assert [line for line in spoken if "localhost:9" not in line] == []
    return seen


@pytest.fixture(scope="module", params=["1280", "768", "400"])
def seen(request: pytest.FixtureRequest, report: dict[str, dict[str, Any]]) -> dict[str, Any]:
    return report[request.param]


def test_no_error_and_no_request(seen, folder):
    assert seen["errors"] == []
    assert seen["resources"] == []
    assert seen["fetched"] == "refused"
    assert seen["directive"] == "connect-src"
    assert not re.search(r"https?:", (folder / "report.html").read_text())


def test_no_sideways_scrolling(seen):
    width, window, chart = seen["widths"]
    assert width <= window
    assert seen["unfolded"] <= window
    assert 300 < chart <= window


def test_axes_have_units(seen):
    distribution, slices, pulses, scatter = seen["labels"]
    assert distribution[-1] == "Current amplitude Iₘₐₓ [1/sample]"
    assert slices[-1] == pulses[-1] == "Time from half maximum [ns]"
    assert scatter == ["Current amplitude Iₘₐₓ [1/sample]", "Drift time, 1 % to maximum [ns]"]
    assert seen["chosen"] == "Drift time, 1 % to maximum [ns]"


def test_single_pulses_of_one_method_are_beside_the_data(seen):
    assert seen["beside"] == [["data", "ren"], ["data", "raw"]]


def test_columns_of_the_cursor_are_seen_with_a_cursor_only(seen):
    assert (seen["idle"], seen["live"]) == ("hidden", "visible")


def test_a_method_is_switched_off_in_all_charts_at_once(seen):
    assert all(seen["rawBefore"])
    assert seen["rawAfter"] == [0, 0, 0, 0]
    assert seen["pressed"] == ["false"] * 4
    assert seen["rawAgain"] == seen["rawBefore"]


@pytest.mark.parametrize("chart", ["distributions", "slices", "pulses", "scatter"])
def test_dragging_zooms_and_a_double_click_goes_back(seen, chart):
    found = seen["zoom"][chart]
    before, zoomed = (
        [float(text.replace("−", "-")) for text in found[key]] for key in ("before", "zoomed")
    )
    span = np.ptp(before)
    assert np.ptp(zoomed) < 0.5 * span  # of the ticks: the range itself is a quarter
    assert found["kept"] == found["zoomed"]  # when a method is switched off and on
    if chart != "scatter":  # whose whole range is that of all points, not the first one
        assert min(before) <= min(zoomed)
        assert max(zoomed) <= max(before)
        assert found["back"] == found["before"]
    assert found["back"] != found["zoomed"]
    assert found["plus"] != found["back"]


def test_the_edge_is_shown_at_a_click(seen):
    whole, edge = ([float(t.replace("−", "-")) for t in seen[key]] for key in ("all", "edge"))
    assert np.ptp(edge) < 0.3 * np.ptp(whole)
    assert min(edge) < 0 < max(edge)


def test_without_a_mean_pulse_of_the_data_the_edge_is_the_whole(seen):
    assert seen["lone"] == seen["all"]


def test_counts_are_those_of_the_values(seen):
    values = synthetic.values_of()["SEP"]["data"]
    axis = synthetic.views_of()["distributions"]["SEP"]["current_amplitude"]
    assert int(seen["below"]) == np.sum(values["current_amplitude"] < axis["low"])
    times = values["drift_time"]
    assert int(seen["none"]) == np.isnan(times).sum() > 0
    low, high = map(float, re.findall(r"[\d.]+", seen["hover"])[:2])
    # the page rounds the edges to four digits
    assert abs(int(seen["bin"]) - np.sum((times >= low) & (times < high))) <= 1


def test_the_cursor_reads_the_pulse(seen):
    time = float(seen["cursor"]["time"].removesuffix(" ns").replace("−", "-"))
    mean = synthetic.superpulses(4)["SEP"]["data"]["mean"][2]
    sample = round(time / synthetic.DT_NS) + 160
    assert float(seen["cursor"]["height"]) == pytest.approx(mean[sample], abs=1e-4)


def test_events_are_picked(seen):
    assert seen["slider"]["moved"]
    assert seen["slider"]["text"].startswith("4 of 20 (simulated pulse ")
    assert seen["next"].startswith("5 of 20")


def test_a_peak_without_data_says_so(seen):
    assert seen["gap"] == "Nothing to show: no measured pulses were scored."
    assert seen["hidden"] == "none"


def test_on_paper_all_is_open_and_nothing_is_cut(report):
    """With the rules for print, in a frame as wide as a sheet."""
    found = report["768"]["printed"]
    assert found["open"] == [True] * len(found["open"])
    assert set(found["hidden"]) == {"none"}
    width, window, chart = found["widths"]
    assert width <= window
    assert 300 < chart <= 16 / 2.54 * 96 + 1
    assert found["closed"] == found["before"]
