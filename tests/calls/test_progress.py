"""How far a call is: on a terminal, in a notebook, in a log."""

from __future__ import annotations

import io
import logging
import sys
from types import SimpleNamespace

import pytest
from rich.console import Console

from cpunet.calls import progress
from cpunet.calls.progress import (
    LoggingMonitor,
    NotebookMonitor,
    NotesKept,
    TerminalMonitor,
    notebook_display,
    shown,
)
from cpunet.jobs.common.monitor import Monitor


class Shown:
    """What a notebook would show, and how often each piece was drawn again."""

    def __init__(self) -> None:
        self.pieces: list[object] = []
        self.updates: list[str] = []

    def __call__(self, piece: object, display_id: bool = False) -> Shown:
        self.pieces.append(piece)
        return self

    def update(self, piece: object) -> None:
        self.updates.append(piece._repr_html_())  # type: ignore[attr-defined]


def test_bars_of_a_notebook(monkeypatch):
    monkeypatch.setattr(progress, "REDRAWN_S", 0)
    display = Shown()
    monitor = NotebookMonitor(display)
    with monitor.stage("Matching <1>", 10) as advance:
        advance(4)
    monitor.note("fit: <good>")
    bar, line = display.pieces
    assert "Matching &lt;1&gt;: 4 of 10" in display.updates[0]
    assert 'max="10" value="4"' in display.updates[0]
    assert 'max="1" value="1"' in display.updates[-1]  # whatever the number, it is over
    assert repr(bar) == "Matching <1>: 4 of 10 in 0 s"
    assert line._repr_html_() == "<small>fit: &lt;good&gt;</small>"
    assert repr(line) == "fit: <good>"


def test_a_stage_that_fails_is_not_shown_as_over():
    display = Shown()
    with pytest.raises(ValueError, match="no"), NotebookMonitor(display).stage("Reading"):
        raise ValueError("no")
    assert "value=" not in display.updates[-1]


def test_bars_of_a_terminal():
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    with TerminalMonitor(console).stage("Reading [a]", 2) as advance:
        advance(2)
    assert "Reading [a]" in console.file.getvalue()  # type: ignore[attr-defined]
    assert "2/2" in console.file.getvalue()  # type: ignore[attr-defined]


def test_notes_are_kept_and_logged(caplog):
    caplog.set_level(logging.INFO, "cpunet")
    monitor = shown(False)
    monitor.note("warning: few pulses")
    monitor.note("fit: good")
    assert monitor.notes == ["warning: few pulses", "fit: good"]
    told = [(record.levelname, record.message) for record in caplog.records]
    assert told == [("WARNING", "few pulses"), ("INFO", "fit: good")]


def test_a_monitor_of_the_user_hears_all():
    class Heard(Monitor):
        def __init__(self) -> None:
            self.texts: list[str] = []

        def state(self, text: str) -> None:
            self.texts.append(text)

        def note(self, message: str) -> None:
            self.texts.append(message)

    heard = Heard()
    kept = NotesKept(heard)
    kept.state("chi-square 1.1")
    kept.note("a remark")
    assert heard.texts == ["chi-square 1.1", "a remark"]
    assert kept.notes == ["a remark"]


def test_what_is_chosen(monkeypatch):
    assert notebook_display() is None
    assert isinstance(shown(True)._passed_to, LoggingMonitor)
    own = Monitor()
    assert shown(own)._passed_to is own
    display = Shown()
    shell = SimpleNamespace(kernel=object())
    notebook = SimpleNamespace(
        get_ipython=lambda: shell, display=SimpleNamespace(display=display)
    )
    monkeypatch.setitem(sys.modules, "IPython", notebook)
    assert isinstance(shown(True)._passed_to, NotebookMonitor)
    assert isinstance(shown(False)._passed_to, LoggingMonitor)
    monkeypatch.setattr(notebook, "get_ipython", lambda: SimpleNamespace())  # a plain console
    assert notebook_display() is None
