"""The page of a crystal's pulses in a headless browser: what is seen, clicked and zoomed."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cpunet.analysis.explorer import Exploration, explorer_page
from cpunet.analysis.nearest import nearest_pulses
from cpunet.analysis.paired import align_half_maximum
from cpunet.pulses.container import Pulses
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector

NAMES = ("chromium", "chromium-browser", "google-chrome")
STEP = 4.0
WATCH = """<script>
window.problems = [];
addEventListener("error", (e) => problems.push(String(e.message)));
addEventListener("unhandledrejection", (e) => problems.push(String(e.reason)));
addEventListener("securitypolicyviolation", (e) => problems.push(e.violatedDirective));
for (const kind of ["error", "warn"])
  console[kind] = (...words) => problems.push(words.join(" "));
</script>"""
HANDS = """<script>
const told = {};
const find = (what) => document.querySelector(what);
const line = (kind, id = "charge") => find(`#${id} path.${kind}`)?.getAttribute("d");
const cell = (i) => document.querySelectorAll("#crystal .cell")[i].getBoundingClientRect();
const pointer = (what, type, x, y) => what.dispatchEvent(new PointerEvent(type,
  { clientX: x, clientY: y, pointerId: 1, bubbles: true, button: 0 }));
const click = (i) => {
  const box = cell(i);
  for (const type of ["pointerdown", "pointerup"])
    pointer(find("#crystal svg"), type, box.x + box.width / 2, box.y + box.height / 2);
};
const key = (name) => find("#crystal").dispatchEvent(
  new KeyboardEvent("keydown", { key: name, bubbles: true, cancelable: true }));
const axis = (within, anchor) => [...document.querySelectorAll(`${within} text`)]
  .filter((t) => t.getAttribute("text-anchor") === anchor && !t.getAttribute("transform")
    && /^[\\u22120-9.]+$/.test(t.textContent))
  .map((t) => [Number(t.textContent.replace("\\u2212", "-")),
               // labels of heights stand 4 pixels below their line
               anchor === "end" ? t.getAttribute("y") - 4 : Number(t.getAttribute("x"))]);
const look = () => ({ where: find("#where").textContent, raw: line("raw"), ren: line("ren"),
  data: document.querySelectorAll("#charge path.data").length, band: line("band"),
  current: line("ren", "current"),
  time: axis("svg.plot", "middle"), height: axis("#charge", "end"),
  rows: [...find("table.legend tbody").rows]
    .map((row) => [...row.cells].map((c) => c.textContent)) });
const drag = (x1, x2, y1, y2) => {
  const box = find("#charge .frame").getBoundingClientRect(), what = find("svg.plot");
  const at = (fx, fy) => [box.x + fx * box.width, box.y + fy * box.height];
  pointer(what, "pointerdown", ...at(x1, y1));
  pointer(what, "pointermove", ...at(x2, y2));
  pointer(what, "pointerup", ...at(x2, y2));
};
const press = (name) => [...document.querySelectorAll(".controls button")]
  .find((one) => one.textContent === name).click();
const fills = () => [...document.querySelectorAll("#crystal .cell")]
  .map((c) => c.getAttribute("fill"));
addEventListener("load", () => {
  try {
    STEPS
  } catch (error) { problems.push(String(error.stack)); }
  told.problems = problems;
  told.requests = performance.getEntriesByType("resource").map((entry) => entry.name);
  told.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const result = document.createElement("pre");
  result.id = "told";
  result.textContent = JSON.stringify(told);
  document.body.append(result);
});
</script>"""
STEPS = """
told.first = look(); told.fills = fills();
click(PLACE); told.clicked = look();
key("ArrowRight"); told.moved = look(); key("ArrowLeft");
click(GREY); told.grey = look();
click(PLACE);
drag(0.4, 0.6, 0.5, 0.5); told.zoomed = look();
press("Edge"); told.edge = look();
drag(0.4, 0.6, 0.2, 0.6); told.boxed = look();
find("svg.plot").dispatchEvent(new MouseEvent("dblclick", { bubbles: true }));
told.back = look();
press("All"); told.all = look(); press("Edge");
drag(0.5, 0.502, 0.5, 0.5); told.nothing = look();
find("#quantity").value = "rms"; find("#quantity").dispatchEvent(new Event("change"));
told.recoloured = fills();
dispatchEvent(new Event("resize"));
"""


@pytest.fixture(scope="module")
def chromium() -> str:
    """The browser; tests skip without one."""
    name = os.environ.get("CPUNET_CHROMIUM")
    found = name or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} found, CPUNET_CHROMIUM not set")
    return found


def logistic(width: np.ndarray[Any, Any], top: float = 1.0) -> np.ndarray[Any, Any]:
    time = np.arange(800)
    return (top / (1 + np.exp((395 - time) / width[:, None]))).astype(np.float32)


@pytest.fixture(scope="module")
def shown() -> Exploration:
    """Logistic pulses, as wide as the place's radius tells; the lithium layer has none."""
    detector = read_detector("bege")
    r, z = (
        side.ravel()
        for side in np.meshgrid(
            np.arange(STEP / 2, detector.crystal_radius, STEP),
            np.arange(STEP / 2, detector.crystal_length, STEP),
        )
    )
    kept = r < 30
    width = 1 + r[kept] / 10 + z[kept] / 100
    recipe = load_recipe("fast")
    translated = np.stack([logistic(width + extra, 0.9) for extra in (0.9, 1.0, 1.3)])
    measured = logistic(np.linspace(1, 7, 40), 0.9)
    edges = np.mean([align_half_maximum(run, 100, 100) for run in translated], axis=0)
    return Exploration(
        detector=detector,
        recipe=recipe,
        runs=("one", "two", "three"),
        dt_ns=16.0,
        step_mm=STEP,
        r_mm=r,
        z_mm=z,
        missing=tuple("" if k else "too near the wall" for k in kept),
        ideal=logistic(width),
        translated=translated,
        measured=Pulses.of(measured, dt_ns=16, energy_kev=np.full(40, 2614.5)),
        nearest=nearest_pulses(edges, measured, 3),
    )


def seen(chromium: str, shown: Exploration, folder: Path, width: int) -> dict[str, Any]:
    """What the hands found in a page `width` pixels wide."""
    place = int(np.flatnonzero((shown.r_mm == 10) & (shown.z_mm == 14))[0])
    grey = next(i for i, why in enumerate(shown.missing) if why)
    steps = STEPS.replace("PLACE", str(place)).replace("GREY", str(grey))
    page = explorer_page(shown)
    page = page.replace("<title>", WATCH + "<title>", 1)
    page = page.replace("</body>", HANDS.replace("STEPS", steps) + "</body>")
    file = folder / "page.html"
    file.write_text(page, encoding="utf-8")
    words = [
        chromium,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=5000",
        f"--user-data-dir={folder / 'profile'}",
        f"--window-size={width},1000",
        "--dump-dom",
        file.as_uri(),
    ]
    done = subprocess.run(words, capture_output=True, timeout=240, check=True)
    found = re.search(r'<pre id="told">(.*?)</pre>', done.stdout.decode(), re.DOTALL)
    assert found, done.stderr.decode()[-2000:]
    return json.loads(unescape(found[1]))


@pytest.fixture(scope="module")
def told(
    chromium: str, shown: Exploration, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    return seen(chromium, shown, tmp_path_factory.mktemp("wide"), 1280)


def curve(look: dict[str, Any], kind: str) -> np.ndarray[Any, Any]:
    """A drawn line as times (ns) and heights, by the labels of the axes."""
    points = np.array([p.split() for p in re.split("[ML]", look[kind]) if p], float)
    return np.stack(
        [
            np.polyval(np.polyfit(*np.array(look[axis])[:, ::-1].T, 1), points[:, column])
            for column, axis in enumerate(("time", "height"))
        ]
    )


def row_of(shown: Exploration, r: float, z: float) -> int:
    kept = [not why for why in shown.missing]
    (row,) = np.flatnonzero((shown.r_mm[kept] == r) & (shown.z_mm[kept] == z))
    return int(row)


def test_nothing_fails_and_nothing_is_requested(told, shown):
    assert told["problems"] == []
    assert told["requests"] == []
    page = explorer_page(shown)
    assert "default-src 'none'" in page
    assert not re.search(r"https?://", page)


def test_a_click_shows_the_pulses_of_that_place(told, shown):
    assert told["clicked"]["where"] == "r = 10.0 mm, z = 14.0 mm"
    assert told["clicked"]["ren"] != told["first"]["ren"]
    row = row_of(shown, 10, 14)
    expected = align_half_maximum(shown.translated[:, row], 150, 400).mean(axis=0)
    time, height = curve(told["clicked"], "ren")
    truth = np.interp(time, (np.arange(550) - 150) * 16, expected)
    near = np.abs(time) < 1500
    np.testing.assert_allclose(height[near], truth[near], atol=0.004)
    _, ideal = curve(told["clicked"], "raw")
    assert ideal.max() == pytest.approx(1, abs=0.005)
    assert told["clicked"]["band"]
    assert told["clicked"]["data"] == 3


def test_the_numbers_are_those_of_the_pulses(told, shown):
    rows = {row[0]: row[1:] for row in told["clicked"]["rows"]}
    assert list(rows) == ["Simulation", "REN translation", "Data 1", "Data 2", "Data 3"]
    # a logistic rises from 10 to 90 % in its width times 2 ln 9
    width = 1 + 1.0 + 0.14
    assert float(rows["Simulation"][2]) == pytest.approx(width * 2 * np.log(9) * 16, abs=2)
    mean, spread = map(float, rows["REN translation"][2].split(" ± "))
    widths = width + np.array([0.9, 1.0, 1.3])
    assert mean == pytest.approx(widths.mean() * 2 * np.log(9) * 16, abs=2)
    assert spread == pytest.approx(widths.std(ddof=1) * 2 * np.log(9) * 16, rel=0.05)
    nearest = shown.nearest.rms[row_of(shown, 10, 14)]
    assert [float(rows[f"Data {n}"][3]) for n in (1, 2, 3)] == pytest.approx(nearest, abs=6e-5)
    assert rows["Data 1"][4] == "2614.5"


def test_arrows_move_to_the_next_place(told):
    assert told["moved"]["where"] == "r = 14.0 mm, z = 14.0 mm"
    assert told["moved"]["ren"] != told["clicked"]["ren"]


def test_a_grey_place_tells_its_reason(told, shown):
    assert told["grey"]["where"].endswith("no pulse, too near the wall")
    assert told["grey"].get("ren") is None
    assert told["grey"]["rows"] == []
    grey = [fill == "#c8c8c8" for fill in told["fills"]]
    assert grey == [bool(why) for why in shown.missing]


def test_dragging_zooms_and_the_buttons_lead_back(told):
    def width(look: dict[str, Any]) -> float:
        time = np.array(look["time"])
        return float(np.ptp(time[:, 0]) / np.ptp(time[:, 1]))

    whole = told["clicked"]
    assert width(told["zoomed"]) == pytest.approx(0.2 * width(whole), rel=0.02)
    assert told["zoomed"]["current"] != whole["current"]
    for look in ("edge", "back", "nothing"):
        assert told[look]["ren"] == whole["ren"]
    low, high = (np.ptp(np.array(told[look]["height"])[:, 0]) for look in ("boxed", "zoomed"))
    assert low < 0.6 * high
    assert max(value for value, _ in told["all"]["time"]) >= 5000


def test_places_are_coloured_by_the_chosen_quantity(told):
    assert len(set(told["fills"])) > 5
    assert told["recoloured"] != told["fills"]


def test_a_narrow_page_does_not_scroll_sideways(chromium, shown, tmp_path):
    told = seen(chromium, shown, tmp_path, 500)
    assert told["problems"] == []
    assert told["overflow"] <= 0
