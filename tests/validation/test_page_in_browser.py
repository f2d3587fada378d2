"""The report's page in a browser: one click hides a method in every figure."""

from __future__ import annotations

from matplotlib.figure import Figure

from browser import browser, run_page
from cpunet.plotting import line_look, styled
from synthetic import write_report

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
def drawn() -> Figure:
    figure = Figure()
    axes = figure.subplots()
    for method, text in (("data", "Data, n = 3"), ("ren", "REN translation, n = 3")):
        axes.plot([1, 2, len(text)], label=text, **line_look(method, "blue"))
    axes.legend()
    return figure


def test_a_click_hides_a_method_in_all_figures(tmp_path):
    browser()  # skips without one
    write_report(tmp_path, {}, {"SEP mean pulse": drawn(), "SEP drift_time": drawn()}, [])
    page = tmp_path / "report.html"
    page.write_text(page.read_text().replace("</body>", SELFTEST))
    seen, log = run_page(page, width=500)
    assert "CONSOLE" not in log
    # a line, and in the legend a line and a text, in each of two figures
    assert seen["before"] == [[True] * 6, [True] * 6, "true"]
    assert seen["hidden"] == [[False] * 6, [True] * 6, "false"]
    assert seen["again"] == seen["before"]
    assert seen["widths"][0] <= seen["widths"][1]
    assert seen["requests"] == 0
