"""How far long work is: a bar on a terminal, lines of a log elsewhere, and nothing torn."""

from __future__ import annotations

import io
import logging
import time
from contextlib import redirect_stderr

import pytest

from cpunet import progress
from cpunet.progress import stage


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    """Lines of a log that is told of every update."""
    monkeypatch.setattr(progress, "LOG_EVERY_S", 0.0)
    caplog.set_level("INFO", "cpunet")
    return caplog


def test_messages_do_not_tear_a_bar_of_a_terminal() -> None:
    with redirect_stderr(Terminal()) as terminal, stage("Reading [a]", 2) as bar:
        bar.update()
        logging.getLogger("cpunet.somewhere").warning("few pulses")
        bar.update()
    assert "\rfew pulses\n\rReading" in terminal.getvalue()
    assert "Reading [a]: 100%" in terminal.getvalue()
    assert "2/2" in terminal.getvalue()


def test_a_log_has_lines_with_the_time_left(log: pytest.LogCaptureFixture) -> None:
    with stage("Matching", 2) as bar:
        for _ in range(3):
            time.sleep(0.01)
            bar.set_postfix_str("chi-square 7", refresh=False)
            bar.update()
    begun, first, second, third, done = log.messages
    assert begun.startswith("Matching: 0/2")
    assert first.endswith(" left, chi-square 7")
    # one that takes longer than its total has no time left, and no total
    assert "left" not in second + third + done
    assert third.startswith("Matching: 3, ")
    assert third.endswith("/s, chi-square 7")
    assert done.startswith("Matching: done in ")


def test_a_log_is_told_of_failures_by_others(log: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ValueError, match="no"), stage("Reading"):
        raise ValueError("no")
    assert not any("done" in message for message in log.messages)
