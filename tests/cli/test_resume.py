"""An interrupted training goes on where it was, however it was interrupted."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable

import pytest

from cpunet.training.unfinished import UnfinishedRun
from synthetic import digests

KEPT = ["--set", "training.checkpoint_interval=1", "--set", "training.log_interval=1"]
SEED = ("--seed", "3")  # of the fixture `trained`


def at_state(monkeypatch, number: int, act: Callable[[], None]) -> None:
    """Do something when so many states were stored."""
    save, calls = UnfinishedRun.save, []

    def watched(self, state):
        save(self, state)
        calls.append(0)
        if len(calls) == number:
            act()

    monkeypatch.setattr(UnfinishedRun, "save", watched)


@pytest.fixture
def words(stand, tiny, tmp_path) -> list[object]:
    return ["train", *stand.inputs, "--out", tmp_path / "run", *SEED, *tiny, *KEPT]


@pytest.mark.parametrize(
    "how",
    [
        pytest.param(signal.SIGTERM, id="TERM"),
        pytest.param(signal.SIGINT, id="INT", marks=pytest.mark.thorough),
    ],
)
def test_a_signal_stops_between_two_iterations(
    command, words, trained, tmp_path, monkeypatch, how
):
    before = signal.signal(how, signal.SIG_DFL)  # which a process of tests may ignore
    with monkeypatch.context() as patched:
        at_state(patched, 2, lambda: signal.raise_signal(how))
        stopped = command(*words)
    signal.signal(how, before)
    assert stopped.code == 128 + how
    assert stopped.out == ""
    told = stopped.err.splitlines()
    assert "stopping after this iteration; once more to stop at once" in told
    assert "stopped after 3 of 4 iterations; resume goes on from it" in told
    assert told[-1].startswith("error: interrupted")
    assert [path.name for path in tmp_path.iterdir()] == ["run.unfinished"]
    assert command(*words, "--resume").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert digests(tmp_path / "run") == digests(trained)
    assert [path.name for path in tmp_path.glob("run/*checkpoint*")] == []
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["resumed_at"] == [3]
