"""Files on the wrong side are refused in one line, before anything is made of them."""

from __future__ import annotations

import pytest


def refused(outcome) -> str:
    assert outcome.code == 2
    return outcome.err.splitlines()[-1]


def test_swapped_sides(command, stand, tiny, trained, tmp_path):
    swapped = ("--sim", stand.data, "--data", stand.sim, "--out", tmp_path / "out")
    for words in (("train", *swapped, *tiny), ("validate", trained, *swapped)):
        line = refused(command(*words))
        assert f"{stand.data}: given as simulated pulses, but these look measured" in line
        assert "are --sim and --data swapped?" in line
        assert "--insist" in line
    both = ("--sim", stand.sim, "--data", stand.sim, "--out", tmp_path / "out")
    assert "look simulated (no noise, no decay)" in refused(command("train", *both, *tiny))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("folder", [False, True])
def test_translating_the_other_side(command, stand, trained, tmp_path, folder):
    out = tmp_path / "made"
    words = ("--out", f"{out}/" if folder else out)
    line = refused(command("translate", trained, stand.data, *words))
    assert "given as simulated pulses, but these look measured" in line
    assert "; give --inverse; if they are simulated, say so with --insist" in line
    line = refused(command("translate", trained, stand.sim, "--inverse", *words))
    assert "given as measured pulses, but these look simulated" in line
    assert "; leave out --inverse" in line
    outcome = command("translate", trained, stand.data, *words, "--insist")
    assert outcome.code == 0  # whoever insists gets it


@pytest.mark.parametrize("inverse", [(), ("--inverse",)])
def test_translating_twice(command, stand, trained, tmp_path, inverse):
    first, again = tmp_path / "first.lh5", tmp_path / "again.lh5"
    source = stand.data if inverse else stand.sim
    assert command("translate", trained, source, "--out", first, *inverse).code == 0
    words = ("translate", trained, first, "--out", again)
    line = refused(command(*words, *inverse, "--insist"))
    assert f"were translated by {'IREN' if inverse else 'REN'} already" in line
    assert "that they were made of" in line
    # there and back again is something else
    assert "already" not in command(*words, *(() if inverse else ("--inverse",))).err
