"""Pile-up tails drawn like those of data behind quality cuts."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import read_electronics
from cpunet.electronics.drawn_tails import (
    SIZES_KEV,
    DrawnTails,
    SameNoise,
    TraceNoise,
    passing,
)
from cpunet.electronics.pile_up_tails import PileUpTails
from cpunet.electronics.readout import read_out
from cpunet.electronics.tails_law import TailsLaw
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.cuts import apply_cuts, fit_cuts
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe

RECIPE = load_recipe("fast")
LAW = TailsLaw(2.0, 54.6, read_electronics("ornl").other_pulses_kev)
BELOW_30 = tuple(float(kev < 30) for kev in SIZES_KEV)
DRAWN = DrawnTails(LAW, 0.9, 0.5, 16.0, BELOW_30)


def test_what_cuts_take_is_not_drawn():
    rng = np.random.default_rng(1)
    kev, all_kev = DRAWN.draw_kev(20_000, rng), DRAWN.uncut().draw_kev(20_000, rng)
    assert kev.max() < 40
    assert (all_kev > 40).mean() == pytest.approx(LAW.share_above(40), abs=0.02)
    # below the cuts it is the same law
    share = (all_kev > 5).sum() - (all_kev > 20).sum()
    passed = (all_kev < 30).sum() / len(all_kev)
    assert ((kev > 5) & (kev < 20)).mean() == pytest.approx(share / len(kev) / passed, rel=0.06)


def test_another_rate_is_without_cuts():
    busy = DRAWN.uncut(20.0)
    assert busy.passed is None
    assert busy.draw_kev(4000, np.random.default_rng(1)).mean() == pytest.approx(
        10 * LAW.mean_kev, rel=0.1
    )


def test_they_are_told_and_read_again():
    again = DrawnTails.of(json.loads(json.dumps(DRAWN.describe())))
    assert again.describe() == DRAWN.describe()


def test_noise_of_several_methods_is_drawn_once_and_is_what_each_would_draw():
    noise = TraceNoise(BaselineNoise(np.full(513, 1e-8), 1024, 16.0, 50), DRAWN)
    energies = np.linspace(500.0, 2000.0, 20)
    # the second as the first; then after another draw, for other pulses, for other records
    asked = [
        (1, 0, energies, 600),
        (1, 0, energies, 600),
        (1, 1, energies, 600),
        (1, 0, energies[:9], 600),
        (1, 0, energies, 700),
        (2, 0, energies, 700),
    ]
    same = SameNoise(noise)
    for seed, before, kev, length in asked:
        own, shared = (np.random.default_rng(seed) for _ in range(2))
        own.random(before), shared.random(before)
        expected = noise.draw(kev, length, own)
        found = same.draw(kev, length, shared)
        np.testing.assert_array_equal(found, expected)
        assert shared.random() == own.random()
        found += 1  # the caller's own


def test_records_get_noise_and_tails_in_proportion_to_their_energies():
    noise = BaselineNoise(np.full(513, 1e-8), 1024, 16.0, 50)
    energies = np.repeat([500.0, 2000.0], 4000)
    rng = np.random.default_rng(3)
    records = TraceNoise(noise, DRAWN).draw(energies, 600, rng)
    assert TraceNoise(noise).draw(energies, 600, rng).std() < 1e-3
    first = records[:, 0] * energies / DRAWN.height
    for part in (first[:4000], first[4000:]):
        assert (part > 5).mean() == pytest.approx(
            (DRAWN.draw_kev(4000, rng) * np.exp(-0.5 / 54.6) > 5).mean(), abs=0.03
        )
    large = first > 20
    ratio = records[large, 500] / records[large, 0]
    assert ratio == pytest.approx(np.exp(-8 / 54.6), rel=1e-3)


@pytest.mark.thorough
def test_what_passes_is_measured_by_adding_tails_to_traces_without():
    rng = np.random.default_rng(1)
    ramps = np.clip(np.arange(300) / rng.uniform(40, 120, (2500, 1)), 0, 1)
    steps = Pulses.of(ramps, dt_ns=4, energy_kev=np.full(2500, 2614.5))
    traces = read_out(steps, read_electronics("ornl", {"earlier_pulses.rate_kHz": 1}), seed=2)
    raw = Pulses.of(traces.waveforms, dt_ns=16, energy_kev=traces.energy_kev)
    prepared = prepare(raw, RECIPE.preparation, "measured")
    cuts = fit_cuts(prepared, RECIPE.cuts)
    kept = apply_cuts(prepared, cuts)
    found = PileUpTails.of(Baselines.of([raw], RECIPE.preparation))
    passed = passing(found, raw[kept.index], RECIPE.preparation, cuts)
    assert passed is not None
    assert passed[0] == 1
    assert passed[-1] == 0
    drawn = DrawnTails(found.fit.law, 0.9, 0.0, 16.0, passed)
    kev, true = drawn.draw_kev(20_000, rng), traces.tails_kev[kept.index]
    for size in (3, 10, 20):
        assert (kev > size).mean() == pytest.approx((true > size).mean(), abs=0.02)
    few = passing(found, raw[slice(0, 5)], RECIPE.preparation, cuts)
    assert few is None
