"""Pile-up tails: their law, what is measured under known ones, and what is drawn."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import read_electronics
from cpunet.electronics.drawn_pile_up import SIZES_KEV, DrawnTails, TailsLaw, energies_at
from cpunet.electronics.measured import passing
from cpunet.electronics.pile_up_tails import PileUpTails, characteristic_exponents, fit_rate
from cpunet.electronics.readout import RawTraces, read_out
from cpunet.errors import CpunetError
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import apply_cuts, fit_cuts, prepare
from synthetic import load_recipe, mean_kev

TH228 = (10, 60, 85, 155, 235, 240, 365, 560, 720, 1980, 2615)
RECIPE = load_recipe("fast")
PREPARATION = RECIPE.preparation
LAW = TailsLaw(2.0, 54.6, read_electronics("ornl").other_pulses_kev)
BELOW_30 = tuple(float(kev < 30) for kev in SIZES_KEV)
DRAWN = DrawnTails(**asdict(LAW), height=0.9, lead_us=0.5, dt_ns=16.0, passed=BELOW_30)


@pytest.mark.parametrize("rate_khz", [0.3, 3.0])
def test_drawn_tails_have_the_characteristic_function_of_the_law(rate_khz: float):
    law = TailsLaw(rate_khz, 54.6, TH228)
    drawn = law.draw(100_000, np.random.default_rng(1))
    assert drawn.mean() == pytest.approx(mean_kev(law), rel=0.1)
    u = np.geomspace(1e-3, 0.5, 10)
    energies = energies_at((np.arange(1000) + 0.5) / 1000, TH228)
    expected = rate_khz * 1e-3 * 54.6
    wanted = np.exp(expected * characteristic_exponents(u, energies).mean(axis=1))
    found = np.exp(1j * u[:, np.newaxis] * drawn).mean(axis=1)
    np.testing.assert_allclose(found, wanted, atol=0.01)  # three errors of either part


@pytest.mark.parametrize("error_kev", [pytest.param(0.3, marks=pytest.mark.thorough), 3.0])
def test_the_rate_is_found_with_little_and_with_much_noise(error_kev: float):
    law, rng = TailsLaw(1.5, 54.6, TH228), np.random.default_rng(3)
    energies = energies_at(rng.random(4000), TH228)
    measured = law.draw(4000, rng) + rng.normal(0, error_kev, 4000)
    found = fit_rate(measured, error_kev, 54.6, energies)
    assert found.law.rate_khz == pytest.approx(1.5, abs=3 * found.rate_error_khz)
    assert found.sigma_kev == pytest.approx(error_kev, rel=0.05)


def traces_of(
    rate_khz: float, preset: str = "ornl", n: int = 2000, **values: object
) -> RawTraces:
    rng = np.random.default_rng(1)
    ramps = np.clip(np.arange(300) / rng.uniform(40, 120, (n, 1)), 0, 1)
    energy = rng.choice([1592.5, 2103.5, 2614.5], n)
    rates = {"earlier_pulses.rate_kHz": rate_khz, "pile_up.rate_kHz": 0.4}
    chain = read_electronics(preset, rates | values)
    return read_out(Pulses.of(ramps, dt_ns=4, energy_kev=energy), chain, seed=2)


def as_pulses(traces: RawTraces) -> Pulses:
    return Pulses.of(traces.waveforms, dt_ns=traces.dt_ns, energy_kev=traces.energy_kev)


@pytest.fixture(scope="module")
def busy() -> RawTraces:
    return traces_of(1.0)


@pytest.fixture(scope="module")
def found(busy: RawTraces) -> PileUpTails:
    raw = as_pulses(busy)
    return PileUpTails.of(Baselines.of([raw[:1000], raw[1000:]], PREPARATION))


def test_each_trace_has_its_tail(busy: RawTraces, found: PileUpTails):
    np.testing.assert_allclose(found.measure(as_pulses(busy)), found.kev, atol=1e-9)
    tails_kev = busy.disturbed["tails_kev"]
    alone = np.isfinite(found.kev) & (busy.disturbed["n_piled"] == 0)
    off = (found.kev - tails_kev)[alone & (tails_kev < 50)]
    assert abs(np.median(off)) < 0.3
    assert 1.4826 * np.median(np.abs(off)) == pytest.approx(found.fit.sigma_kev, rel=0.1)
    large = alone & (tails_kev > 100)
    # heights of pulses, not their charge, are the scale: 1.5 % less of `ornl`
    assert np.median(found.kev[large] / tails_kev[large]) == pytest.approx(1, abs=0.02)
    assert alone.mean() > 0.9


def test_rate_and_decay_are_found_without_the_energies(found: PileUpTails):
    assert found.level_weight
    # tails within the window are 25 % steeper, by the decay of 2.9 us
    assert found.decay_us == pytest.approx(54.6, rel=0.01)
    assert found.law is not None
    assert found.law.rate_khz == pytest.approx(1, abs=3 * found.fit.rate_error_khz)
    assert found.fit.rate_error_khz < 0.12
    assert found.describe().percent_above["30_kev"]["law"] == pytest.approx(10.5, abs=1.5)


@pytest.mark.thorough
def test_rates_of_slow_decays_and_none_and_too_many():
    def measured(rate_khz: float, preset: str = "legend200", n: int = 2000) -> PileUpTails:
        raw = as_pulses(traces_of(rate_khz, preset, n))
        return PileUpTails.of(Baselines.of([raw], PREPARATION))

    for preset in ("ornl", "legend200"):
        none = measured(0.0, preset)
        assert none.law is None
        assert none.describe().rate_khz == 0
    slow = measured(0.3)  # by their levels
    assert slow.law is not None
    assert slow.law.rate_khz == pytest.approx(0.3, abs=3 * slow.fit.rate_error_khz)
    assert slow.decay_us == pytest.approx(570, rel=0.05)
    with pytest.raises(CpunetError, match="nearly all traces lie on pile-up tails"):
        measured(3.0, n=3000)


def test_levels_that_tell_nothing_are_left_out():
    """Behind a capacitor levels say nothing: here each trace has lost its own."""
    # a single decay: that of tails is taken from the pulses'
    busy = traces_of(1.0, decays=[{"fraction": 1, "tau_us": 54.6}])
    raw = as_pulses(busy)
    lost = 8000 + raw.waveforms - raw.waveforms[:, :400].mean(axis=1, keepdims=True)
    blocks = [raw.with_waveforms(lost.astype(np.float32))]
    found = PileUpTails.of(Baselines.of(blocks, PREPARATION))
    assert not found.level_weight
    assert found.describe().told_by == "slope"
    tails_kev, sigma_kev = busy.disturbed["tails_kev"], found.fit.sigma_kev
    known = np.isfinite(found.kev)
    large = known & (busy.disturbed["n_piled"] == 0) & (tails_kev > 100)
    assert np.median(found.kev[large] / tails_kev[large]) == pytest.approx(1, abs=0.1)
    # noise is measured where slopes are negative: it has all its power, and few tails
    empty = found.empty(blocks[0])
    assert (tails_kev[empty] > sigma_kev).mean() < 0.05
    little = known & (tails_kev < 0.2 * sigma_kev)
    square, alone = found.kev[little & empty] ** 2, found.kev[little] ** 2
    assert square.mean() == pytest.approx(alone.mean(), rel=0.15)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda raw: raw[slice(0, 10)], "only 10 of 10 traces can be prepared"),
        (lambda raw: raw.with_waveforms(-raw.waveforms), "can be prepared"),
        (lambda raw: raw.with_waveforms(raw.waveforms[:, 430:]), "pulse_at_edge"),
        (lambda raw: Pulses.of(raw.waveforms, dt_ns=16), "have a known energy"),
    ],
)
def test_what_cannot_be_told_is_said_in_a_line(busy: RawTraces, change, said: str):
    with pytest.raises(CpunetError, match=said):
        PileUpTails.of(Baselines.of([change(as_pulses(busy)[:400])], PREPARATION))


def test_more_pulses_than_memory_holds_are_refused():
    with pytest.raises(CpunetError, match="give a lower rate, or a shorter decay or record"):
        TailsLaw(0.02, 1e12, TH228).draw(1000, np.random.default_rng(1))


def test_what_cuts_take_is_not_drawn():
    rng = np.random.default_rng(1)
    kev, all_kev = DRAWN.draw_kev(20_000, rng), LAW.draw(20_000, rng)
    assert kev.max() < 40
    assert (all_kev > 40).mean() == pytest.approx(LAW.share_above(40), abs=0.02)
    # below the cuts it is the same law
    share = (all_kev > 5).sum() - (all_kev > 20).sum()
    passed = (all_kev < 30).sum() / len(all_kev)
    assert ((kev > 5) & (kev < 20)).mean() == pytest.approx(share / len(kev) / passed, rel=0.06)


def test_records_get_noise_and_tails_in_proportion_to_their_energies():
    noise = BaselineNoise(np.full(513, 1e-8), 1024, 16.0, 50)
    energies = np.repeat([500.0, 2000.0], 4000)
    rng = np.random.default_rng(3)
    records = replace(noise, tails=DRAWN).draw(energies, 600, rng)
    assert noise.draw(energies, 600, rng).std() < 1e-3
    first = records[:, 0] * energies / DRAWN.height
    for part in (first[:4000], first[4000:]):
        late = DRAWN.draw_kev(4000, rng) * np.exp(-0.5 / 54.6)
        assert (part > 5).mean() == pytest.approx((late > 5).mean(), abs=0.03)
    large = first > 20
    ratio = records[large, 500] / records[large, 0]
    assert ratio == pytest.approx(np.exp(-8 / 54.6), rel=1e-3)


@pytest.mark.thorough
def test_what_passes_is_measured_by_adding_tails_to_traces_without():
    rng, traces = np.random.default_rng(1), traces_of(1.0, n=2500)
    raw = as_pulses(traces)
    prepared = prepare(raw, PREPARATION, "measured")
    cuts = fit_cuts(prepared, RECIPE.cuts)
    kept = apply_cuts(prepared, cuts)
    found = PileUpTails.of(Baselines.of([raw], PREPARATION))
    passed = passing(found, raw[kept.index], PREPARATION, cuts)
    assert passed is not None
    assert passed[0] == 1
    assert passed[-1] == 0
    drawn = DrawnTails(**asdict(found.fit.law), height=0.9, lead_us=0, dt_ns=16, passed=passed)
    kev, true = drawn.draw_kev(20_000, rng), traces.disturbed["tails_kev"][kept.index]
    for size in (3, 10, 20):
        assert (kev > size).mean() == pytest.approx((true > size).mean(), abs=0.02)
    assert passing(found, raw[:5], PREPARATION, cuts) is None
