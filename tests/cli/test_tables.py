"""No number of a table is ever cut, however narrow the screen."""

from __future__ import annotations

import re

import pytest
from rich.console import Console
from rich.table import Table

from cpunet.cli import compare, messages, response, scores

WIDTHS = [20, 60, 80, 200]
METHODS = ("raw", "rc", "gauss_exp", "superpulse", "ren", "truth", "ceiling")
PARAMETERS = ("current_amplitude", "drift_time", "tail_slope")


@pytest.fixture(params=WIDTHS)
def screen(request, monkeypatch) -> int:
    """A terminal of some width."""
    narrow = Console(width=request.param)
    monkeypatch.setattr(messages, "out", narrow)
    return int(request.param)


def iou(row: int, column: int) -> float:
    return 10 + 9 * row + column + 0.1 * column


def metrics(*missing: str) -> dict:
    peaks = {}
    for i, peak in enumerate(("FEP", "SEP", "DEP", "1500-1580")):
        if peak in missing:
            reason = "no measured pulses (at least 10 are needed)"
            peaks[peak] = {"missing": reason, "parameters": {}}
            continue
        peaks[peak] = {
            "parameters": {
                name: {"iou": {m: iou(3 * i + j, k) for k, m in enumerate(METHODS)}}
                for j, name in enumerate(PARAMETERS)
            }
        }
    return {"peaks": peaks}


def require_whole(printed: str, numbers: list[str]) -> None:
    assert "…" not in printed
    found = re.findall(r"\S+", printed)
    for number in numbers:
        assert all(word in found for word in number.split()), number


@pytest.mark.parametrize("missing", [(), ("DEP",), ("FEP", "DEP", "1500-1580")])
def test_scores(screen, capsys, missing):
    scores.print_scores(metrics(*missing))
    printed = capsys.readouterr().out
    rows = [3 * i + j for i in range(4) for j in range(3)]
    shown = [row for row in rows if ("FEP", "SEP", "DEP", "1500-1580")[row // 3] not in missing]
    require_whole(printed, [f"{iou(r, k):.1f}" for r in shown for k in range(7)])
    for peak in missing:
        line = f"{peak}: not scored, no measured pulses (at least 10 are needed)"
        assert line in printed.splitlines()
    if screen >= (60 if "1500-1580" in missing else 80):
        table = [line for line in printed.splitlines() if "not scored" not in line]
        assert max(map(len, table)) <= screen


def test_other_tables(screen, capsys):
    from cpunet.validation.side_by_side import side_by_side

    names = [f"run_{i}_of_a_long_name" for i in range(5)]
    full = metrics()
    for peak in full["peaks"].values():
        for one in peak["parameters"].values():
            one["iou_std"] = dict.fromkeys(METHODS, 1.5)
        peak |= {"n_sim": 100, "n_data": 100}
    table = side_by_side(dict.fromkeys(names, full), "ren")
    messages.tell(compare.comparison_table(table, "Scores"))
    cells = [cell.text for row in table.rows for cell in row.cells]
    require_whole(capsys.readouterr().out, cells)

    values = {"pole_1_ns": 38.1234, "decay_us": 55.43, "noise_rms_kev": 1.953}
    runs = [{"path": name, "values": values, "errors": {}} for name in names]
    truth = {"name": "legend200", "values": values, "difference": values, "sigma": values}
    spread = dict.fromkeys(values, 0.0123)
    told = {"runs": runs, "mean": values, "spread": spread, "truth": truth}
    messages.tell(response.response_table(told))
    require_whole(capsys.readouterr().out, ["38.12", "55.43 ± 0.012", "1.953", "+55.4"])


def test_markup_and_empty_tables(screen, capsys):
    table = Table("name", title="nothing")
    messages.tell(table)
    table = Table("name")
    table.add_column("value", justify="right")
    table.add_row("[bold]a[/]", "[bold]123456789.123456789[/]")
    messages.tell(table)
    assert "123456789.123456789" in capsys.readouterr().out
