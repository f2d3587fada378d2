"""OpenMP's threads soon sleep, unless the user says otherwise."""

from __future__ import annotations

import os

import pytest

from cpunet.cli import SPIN_COUNT, sound_environment


@pytest.mark.parametrize(
    ("name", "value", "spins"),
    [
        ("HOME", "/", SPIN_COUNT),
        ("GOMP_SPINCOUNT", "77", "77"),
        ("OMP_WAIT_POLICY", "PASSIVE", None),
    ],
)
def test_threads_soon_sleep_unless_the_user_says_otherwise(monkeypatch, name, value, spins):
    for known in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.setenv(known, "")
        monkeypatch.delenv(known)
    monkeypatch.setenv(name, value)
    sound_environment()
    assert os.environ.get("GOMP_SPINCOUNT") == spins
