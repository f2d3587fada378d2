"""Delayed charge of the lithium layer: known limits, and reboost's own model of it."""

from __future__ import annotations

from pathlib import Path

import lh5
import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.legend.lithium import LithiumLayer, arrived, delayed, lithium_table


def test_what_arrives_in_the_end() -> None:
    # without recombination the chance is the share of the way; with it everywhere, sinh
    depth = np.array([0.1, 0.33, 0.75])
    late = [1e7]
    free = arrived(LithiumLayer(1.0, recombination_depth_mm=0.0), depth, late)[:, 0]
    np.testing.assert_allclose(free, depth, atol=1e-6)
    layer = LithiumLayer(1.0, recombination_depth_mm=1.0, lifetime_ns=2000.0)
    length = np.sqrt(290e-7 * 2000)
    expected = np.sinh(depth / length) / np.sinh(1 / length)
    np.testing.assert_allclose(arrived(layer, depth, late)[:, 0], expected, rtol=1e-3)


def test_when_it_arrives() -> None:
    layer, time = LithiumLayer(1.0, recombination_depth_mm=0.0), np.arange(40_000.0)
    share = arrived(layer, [0.6, 0.98, 1.0, 3.0], time)
    assert (np.diff(share, axis=1) >= -1e-12).all()
    np.testing.assert_allclose(share[2:], 1)
    # mean time of those that arrive, from 0.6 of the way: (1 - 0.36) L²/6D
    coming = np.diff(share[0])
    mean = (coming * (time[1:] - 0.5)).sum() / coming.sum()
    assert mean == pytest.approx(0.64 / 6 / 290e-7, rel=0.01)
    # near the boundary, as from a wall in an endless layer
    from scipy.special import erfc

    early = np.array([100.0, 400.0])
    near = arrived(layer, [0.98], early)[0]
    np.testing.assert_allclose(near, erfc(0.02 / np.sqrt(4 * 290e-7 * early)), atol=3e-3)


@pytest.mark.slow  # compiles reboost's model
def test_reboosts_model() -> None:
    surface = pytest.importorskip("reboost.hpge.surface")
    layer, time = LithiumLayer(1.0), np.arange(10_001.0)
    depth = np.array([0.5, 0.7, 0.9])
    found = arrived(layer, depth, time)
    for share, mm in zip(found, depth, strict=True):
        # in cells of 10 µm and steps of 1 ns
        theirs = surface.get_surface_response(1000, init=1000 * mm)
        np.testing.assert_allclose(share[1:], theirs[: len(share) - 1], atol=0.01)


def test_a_delayed_pulse_ends_at_what_arrives() -> None:
    layer = LithiumLayer(1.0)
    time = np.arange(8000.0)
    pulse = np.clip((time - 300) / 400, 0, 1)[np.newaxis].astype(np.float32)
    share = arrived(layer, [0.8], time)
    late = delayed(pulse, share)
    assert late[0, -1] == pytest.approx(share[0, -1], abs=2e-3)
    half = np.argmax(late[0] > 0.5 * late[0, -1])
    assert half > np.argmax(pulse[0] > 0.5) + 100
    at_once = delayed(pulse, np.ones_like(share))
    np.testing.assert_allclose(at_once, pulse, atol=1e-5)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((0.0,), "thickness_mm is 0.0"),
        ((1.0, 2.0), "down to 2.0 mm of 1.0"),
        ((1, 0.5, -3), "-3"),
    ],
)
def test_numbers_without_a_meaning(numbers: tuple[float, ...], words: str) -> None:
    with pytest.raises(CpunetError, match=words):
        LithiumLayer(*numbers)


@pytest.mark.slow
def test_the_file_serves_reboosts_surface_model(tmp_path: Path) -> None:
    psd = pytest.importorskip("reboost.hpge.psd")
    told = lithium_table(LithiumLayer(1.0), tmp_path / "lithium.lh5")
    assert 0.5 < told.dead_mm < 0.8
    made = lh5.read("lithium", str(tmp_path / "lithium.lh5"))
    assert made["arrived"].nda.shape == (10_000, 100)
    np.testing.assert_array_equal(made["activeness"].nda, made["arrived"].nda[-1])
    template = np.exp(-0.5 * ((np.arange(4001.0) - 1000) / 40) ** 2)
    columns = psd.make_convolved_surface_library(template, made["arrived"].nda)
    highest = columns.max(axis=0)
    # the deeper, the nearer to the bulk's current; near the surface nothing
    assert highest[-1] == pytest.approx(1)
    assert highest[2] < 0.01
    assert (np.diff(highest[20:]) > 0).all()
    with pytest.raises(CpunetError, match="exists already"):
        lithium_table(LithiumLayer(1.0), tmp_path / "lithium.lh5")
    with pytest.raises(CpunetError, match="give a thicker one"):
        lithium_table(LithiumLayer(0.005, 0.001), tmp_path / "x.lh5")
