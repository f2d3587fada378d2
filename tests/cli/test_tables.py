"""No number of a table is ever cut, however narrow the screen."""

from __future__ import annotations

import re

import pytest
from rich.console import Console
from rich.table import Table

from cpunet.cli import messages, response

WIDTHS = [20, 60, 80, 200]


@pytest.fixture(params=WIDTHS)
def screen(request, monkeypatch) -> int:
    """A terminal of some width."""
    narrow = Console(width=request.param)
    monkeypatch.setattr(messages, "out", narrow)
    return int(request.param)


def require_whole(printed: str, numbers: list[str]) -> None:
    assert "…" not in printed
    found = re.findall(r"\S+", printed)
    for number in numbers:
        assert all(word in found for word in number.split()), number


def test_other_tables(screen, capsys):
    names = [f"run_{i}_of_a_long_name" for i in range(5)]
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
