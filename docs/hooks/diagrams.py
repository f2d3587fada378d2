"""Draw the diagrams of the concept pages: `make docs` writes their SVG files from the code."""

from __future__ import annotations

import ast
import tomllib
from collections import Counter
from html import escape
from pathlib import Path

import numpy as np

PICTURES = Path(__file__).parents[1] / "pictures"
ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "cpunet"
ROOMS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["cpunet"]["rooms"]
INK, LINE, SIM, DATA, LEARNED = "#222", "#777", "#dbe7f6", "#fde6cf", "#dff0df"
FONT = "font-family='system-ui, sans-serif'"


class Drawing:
    """Boxes, arrows and curves on a white ground; lengths are pixels from the upper left."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.size = width, height
        self.parts = [f"<title>{escape(title)}</title>"]
        self.parts.append(f"<rect width='{width}' height='{height}' fill='#fff'/>")

    def text(
        self,
        x: float,
        y: float,
        words: str,
        size: int = 13,
        anchor: str = "middle",
        more: str = "",
    ) -> None:
        style = f"{FONT} font-size='{size}' fill='{INK}' text-anchor='{anchor}'{more}"
        self.parts.append(f"<text x='{x:g}' y='{y:g}' {style}>{escape(words)}</text>")

    def box(self, x: float, y: float, w: float, h: float, fill: str, *lines: str) -> None:
        self.parts.append(
            f"<rect x='{x:g}' y='{y:g}' width='{w:g}' height='{h:g}' rx='6' fill='{fill}' "
            f"stroke='{LINE}'/>"
        )
        first = y + h / 2 - 8.5 * (len(lines) - 1) + 4.5
        for i, line in enumerate(lines):
            self.text(x + w / 2, first + 17 * i, line, 13 if i == 0 else 11)

    def arrow(self, *points: tuple[float, float], dashed: bool = False) -> None:
        path = " ".join(f"{x:g},{y:g}" for x, y in points)
        dash = " stroke-dasharray='5 4'" if dashed else ""
        self.parts.append(
            f"<polyline points='{path}' fill='none' stroke='{LINE}' stroke-width='1.5'"
            f"{dash} marker-end='url(#head)'/>"
        )

    def bow(
        self,
        x: float,
        first: float,
        last: float,
        reach: float,
        ink: str,
        width: float,
        head: bool,
    ) -> None:
        """A curve from one height to another at x, out to three quarters of its reach."""
        end = " marker-end='url(#head)'" if head else " stroke-opacity='0.55'"
        self.parts.append(
            f"<path d='M{x:g},{first:g} C{x + reach:g},{first:g} {x + reach:g},{last:g} "
            f"{x:g},{last:g}' fill='none' stroke='{ink}' stroke-width='{width:.2f}'{end}/>"
        )

    def curve(self, x: float, y: float, w: float, h: float, values: np.ndarray) -> None:
        """Values from 0 (bottom) to 1 (a little below the top) over the whole width."""
        xs = x + w * np.linspace(0, 1, len(values))
        ys = y + h * (0.92 - 0.8 * values)
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(xs, ys, strict=True))
        self.parts.append(f"<rect x='{x}' y='{y}' width='{w}' height='{h}' fill='#fafafa'/>")
        self.parts.append(
            f"<polyline points='{path}' fill='none' stroke='#3949ab' stroke-width='1.6'/>"
        )

    def write(self, name: str) -> None:
        width, height = self.size
        head = (
            "<defs><marker id='head' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='7' "
            "markerHeight='7' orient='auto'>"
            f"<path d='M0 0L8 4L0 8z' fill='{LINE}'/></marker></defs>"
        )
        svg = f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {height}'>\n"
        (PICTURES / name).write_text(svg + "\n".join([head, *self.parts]) + "\n</svg>\n")


ROOM_WORDS = {
    "recipes": "settings of a run, in YAML",
    "pulses": "read, prepare, cut; parameters",
    "simulation": "hits → fields → drift → charge",
    "electronics": "test stands, noise, pile-up tails",
    "networks": "chain as a layer, U-Net",
    "training": "fit of a chain, CycleGAN, run",
    "calibration": "detector and chain together",
    "translation": "REN, IREN on files; ONNX, dspeed",
    "validation": "scores, data vs data, report",
    "legend": "pulse-shape libraries, parameters",
}
FLOWS = (
    ("simulation", "pulses", "charge pulses"),
    ("electronics", "pulses", "raw traces"),
    ("pulses", "training", "windows of both sides"),
    ("simulation", "calibration", "hits, detector"),
    ("training", "translation", "run"),
    ("calibration", "translation", "calibrated run"),
    ("training", "legend", "run"),
    ("translation", "validation", "translated pulses"),
)


def imports() -> dict[tuple[str, str], int]:
    """Number of modules of a room that import from another one."""
    count: Counter[tuple[str, str]] = Counter()
    for room in ROOMS:
        for path in (SOURCE / room).rglob("*.py"):
            # a run imports from later rooms when it is asked to, see tests/test_rooms.py
            tree = ast.parse(path.read_text("utf-8"))
            nodes = tree.body if path.name == "run.py" else ast.walk(tree)
            modules = (n.module or "" for n in nodes if isinstance(n, ast.ImportFrom))
            others = {name.split(".")[1] for name in modules if name.startswith("cpunet.")}
            count.update((room, other) for other in others & {*ROOMS} - {room})
    return dict(count)


def rooms() -> None:
    """Rooms from top to bottom; data between them on the left, imports on the right."""
    x, width, height, step = 300, 250, 42, 56
    d = Drawing(860, 60 + step * len(ROOMS), "Rooms of the package: data and imports")
    middle = {room: 50 + step * i + height / 2 for i, room in enumerate(ROOMS)}
    d.text(150, 24, "data")
    d.text(x + width / 2, 24, "rooms")
    d.text(x + width + 130, 24, "imports (width: number of modules)")
    for room, y in middle.items():
        d.box(x, y - height / 2, width, height, SIM, room, ROOM_WORDS[room])
    labels = []
    for source, target, words in FLOWS:
        first, last = middle[source] + 6, middle[target] - 6
        reach = 40 + 0.5 * abs(last - first)
        d.bow(x, first, last, -reach, LINE, 1.8, head=True)
        labels.append((x - 0.75 * reach + 8, (first + last) / 2 + 4, words))
    for (room, other), n in sorted(imports().items()):
        first, last = middle[room] - 5, middle[other] + 5
        reach = 30 + 0.42 * abs(last - first)
        d.bow(x + width, first, last, reach, "#3949ab", 0.5 * n**0.5, head=False)
    for label in labels:  # in front of all lines
        d.text(*label, 11, "end", " stroke='#fff' stroke-width='4' paint-order='stroke'")
    d.write("rooms.svg")


# steps of each way: a room, and a function, class or method in it
WAYS = {
    "trace": (
        "pulses.open_pulses",
        "pulses.prepare",
        "pulses.apply_cuts",
        "electronics.noise_of",
        "training.fit_response",
        "training.verdict",
        "validation.score_peak",
    ),
    "hit": (
        "simulation.read_hits",
        "simulation.merge_hits",
        "simulation.Simulator.events",
        "pulses.prepare",
        "translation.Translator.translate_pulses",
        "validation.score_peak",
    ),
    "run": (
        "recipes.load_recipe",
        "training.train_chain",
        "training.Run",
        "translation.REN",
        "translation.translate",
        "validation.evaluate",
        "legend.export_legend",
    ),
}
Step = ast.FunctionDef | ast.ClassDef


def definitions(room: str) -> dict[str, tuple[Path, Step]]:
    """Functions, classes and methods of a room; of one name, that of the module so named."""
    steps: dict[str, tuple[Path, Step]] = {}
    for path in sorted((SOURCE / room).rglob("*.py")):
        for node in ast.parse(path.read_text("utf-8")).body:
            if not isinstance(node, Step) or (node.name in steps and path.stem != node.name):
                continue
            steps[node.name] = path, node
            methods = node.body if isinstance(node, ast.ClassDef) else []
            for method in methods:
                if isinstance(method, ast.FunctionDef):
                    steps[f"{node.name}.{method.name}"] = path, method
    return steps


def way(name: str) -> None:
    """Boxes of the steps with the first lines of their docstrings; arrows: what they return."""
    steps, height, pitch = WAYS[name], 44, 76
    d = Drawing(860, 10 + pitch * len(steps), f"The way of a {name} through the rooms")
    for i, step in enumerate(steps):
        room, _, function = step.partition(".")
        defined = definitions(room)
        if function not in defined:
            raise SystemExit(
                f"{__file__}: no {step} any more; name another step of WAYS[{name!r}]"
            )
        path, node = defined[function]
        y = 10 + pitch * i
        if i == 0 or room != steps[i - 1].partition(".")[0]:
            d.text(90, y + height / 2 + 5, room)
        about = (ast.get_docstring(node) or "").splitlines()[0].replace("`", "")
        module = path.relative_to(SOURCE).as_posix()
        d.box(180, y, 670, height, SIM, f"{function} ({module})", about)
        if i + 1 < len(steps):
            d.arrow((515, y + height), (515, y + pitch))
            returned = node.returns if isinstance(node, ast.FunctionDef) else None
            label = node.name if returned is None else ast.unparse(returned)
            d.text(528, y + height + 20, label, 11, "start")
    d.write(f"way-of-a-{name}.svg")


def chain() -> None:
    """The stages of a readout, with the pulse after each: computed, not sketched."""
    dt_ns, n = 4.0, 1100
    t = np.arange(n) * dt_ns
    charge = np.interp(t, [600, 1300, 1520], [0.0, 0.35, 1.0])

    def after(values: np.ndarray, impulse: np.ndarray) -> np.ndarray:
        return np.convolve(values, impulse)[:n]

    def pole(tau_ns: float) -> np.ndarray:
        return np.exp(-t / tau_ns) / np.exp(-t / tau_ns).sum()

    smooth = after(after(charge, pole(60)), pole(40))
    slow = 0.93 * smooth + 0.07 * after(smooth, pole(400))
    decayed = after(np.diff(slow, prepend=0), np.exp(-t / 12_000))
    noise = after(np.random.default_rng(1).normal(0, 0.06, n), pole(30))
    d = Drawing(860, 210, "A readout chain: charge, bandwidth, late charge, decay, noise")
    stages = [
        ("charge", "of the simulation", charge),
        ("bandwidth", "two poles", smooth),
        ("late charge", "five fixed times", slow),
        ("decay", "of the preamplifier", decayed),
        ("noise", "of real baselines", decayed + noise),
    ]
    for i, (name, what, values) in enumerate(stages):
        x = 10 + 172 * i
        d.curve(x, 50, 148, 110, values[::3])
        d.text(x + 74, 24, name)
        d.text(x + 74, 41, what, 11)
        if i:
            d.arrow((x - 22, 105), (x - 3, 105))
    d.text(430, 185, "4.4 µs; late charge, decay and noise drawn larger than they are", 11)
    d.text(
        430,
        203,
        "recipe fast fits bandwidth, late charge and decay; the noise is that of the data",
        11,
    )
    d.write("chain.svg")


def networks() -> None:
    d = Drawing(
        860, 400, "The CycleGAN: two generators, two discriminators, three kinds of loss"
    )
    d.box(20, 60, 150, 50, SIM, "simulated window")
    d.box(20, 250, 150, 50, DATA, "measured window")
    d.box(240, 60, 150, 50, LEARNED, "REN", "Positional U-Net")
    d.box(240, 250, 150, 50, LEARNED, "IREN", "Positional U-Net")
    d.box(460, 60, 150, 50, DATA, "like data")
    d.box(460, 250, 150, 50, SIM, "like simulation")
    d.box(690, 60, 150, 50, "#eee", "discriminator", "GRU with attention")
    d.box(690, 250, 150, 50, "#eee", "discriminator", "GRU with attention")
    for y in (85, 275):
        d.arrow((170, y), (240, y))
        d.arrow((390, y), (460, y))
        d.arrow((610, y), (690, y))
    d.text(650, 50, "adversarial loss", 11)
    d.text(650, 324, "adversarial loss", 11)
    d.arrow((535, 110), (535, 165), (345, 165), (345, 250), dashed=True)
    d.arrow((535, 250), (535, 195), (285, 195), (285, 110), dashed=True)
    d.text(640, 172, "cycle loss: both in turn", 11)
    d.text(640, 188, "must give the pulse again", 11)
    d.arrow((95, 250), (95, 180), (255, 180), (255, 110), dashed=True)
    d.text(110, 150, "identity loss: REN leaves", 11)
    d.text(110, 166, "measured pulses alone", 11)
    d.text(430, 360, "The two sides are drawn independently; no pulse has a partner.", 12)
    d.text(430, 380, "The likewise identity loss of IREN is not drawn.", 11)
    d.write("networks.svg")


if __name__ == "__main__":
    for draw in (rooms, chain, networks):
        draw()
    for name in WAYS:
        way(name)
