"""Raw traces of which it is known what is wrong with them, and which side they are of."""

from __future__ import annotations

import logging
import re

import numpy as np
import pytest

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.provenance import (
    apparent_side,
    mismatched,
    recorded_side,
    require_side,
    rolled_over,
    second_rate,
)
from cpunet.pulses.reading import open_pulses
from cpunet.pulses.reading.files import PulseFile
from cpunet.pulses.writing import PulseWriter
from synthetic import load_recipe, write_pulses, write_table

RECIPE = load_recipe("fast")
FEP = parse_selection("FEP", RECIPE.peaks)
DT_NS, N, BASE, GAIN, DECAY = 16.0, 400, 2000.0, 4.0, 3750.0  # decay in samples
LINES = np.array([2614.511, 2103.511, 1592.511, 900.0])
TIME = np.arange(800)


def kev(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).choice(LINES, N)


def traces(energies: np.ndarray, length: int = 1400, sign: int = 1) -> np.ndarray:
    """A rise of ten samples at sample 600, a decay, noise, and whole numbers."""
    rng, at = np.random.default_rng(1), np.arange(length) - 600.0
    shape = np.clip(at / 10, 0, 1) * np.exp(-np.maximum(at, 0) / DECAY)
    noise = rng.normal(0, 4, (len(energies), length))
    return np.rint(BASE + sign * GAIN * energies[:, np.newaxis] * shape + noise)


def written(path, waveforms, energies) -> PulseFile:
    write_pulses(path, Pulses.of(waveforms, dt_ns=DT_NS, energy_kev=energies))
    return PulseFile(path)


@pytest.mark.parametrize("resolution", [0.0, 0.02])
def test_amplitudes_go_with_their_energies_and_with_no_others(resolution):
    rng, energies = np.random.default_rng(3), kev()
    amplitudes = GAIN * energies * rng.normal(1, resolution, N)
    assert mismatched(energies, amplitudes) == 0
    different = np.mean(energies != np.roll(energies, 1))
    assert mismatched(np.roll(energies, 1), amplitudes) == pytest.approx(different, abs=0.1)
    assert mismatched(np.roll(energies, 1), np.ones(N)) == 0  # scaled to one height


@pytest.mark.parametrize("wrong", ["order", "saturated", "padded"])
def test_energies_of_other_pulses_are_refused_unless_insisted(tmp_path, wrong):
    """Or amplitudes of a saturated amplifier, or above baselines of padding.

    As in https://github.com/XENON1T/pax/issues/211, https://github.com/AxFoundation/strax/issues/177.
    """
    energies, counts = np.roll(kev(), wrong == "order"), traces(kev())
    if wrong == "saturated":
        counts = np.minimum(counts, 9000) + np.random.default_rng(5).integers(0, 3, (N, 1400))
    if wrong == "padded":
        counts[::2, :350] = 0
    file = written(tmp_path / "raw.lh5", counts, energies)
    with pytest.raises(CpunetError, match=r"% of amplitudes and energies do not go together"):
        load_pulses(file, "measured", RECIPE, FEP)
    load_pulses(PulseFile(file.path, insist=True), "measured", RECIPE, FEP)


@pytest.mark.parametrize("averaged", [2, 4])
def test_a_second_rate_is_found_at_its_sample_and_told(tmp_path, caplog, averaged):
    start = 1000
    fine = traces(kev(), start + 500 * averaged)
    coarse = fine[:, start:].reshape(N, 500, averaged).mean(axis=2)
    both = np.rint(np.concatenate([fine[:, :start], coarse], axis=1)).astype(np.float32)
    found = second_rate(both)
    assert found == (pytest.approx(start, abs=8), pytest.approx(averaged, rel=0.1))
    assert second_rate(fine[:, :1500].astype(np.float32)) is None
    load_pulses(written(tmp_path / "two.lh5", both, kev()), "measured", RECIPE, FEP)
    assert any("a second rate" in message for message in caplog.messages)


@pytest.mark.parametrize("key", ["event_number", "timestamp"])
def test_energies_of_another_file_are_joined_by_the_events_of_both(tmp_path, key, caplog):
    """Rows in another order, and fewer of them."""
    caplog.set_level(logging.INFO)
    numbers, energies = np.arange(100, 100 + N), kev()
    raw = write_table(tmp_path / "raw.lh5", "ch1/raw", traces(energies), **{key: numbers})
    order = np.random.default_rng(2).permutation(N)[: N - 10]
    hit = tmp_path / "hit.lh5"
    write_table(hit, "ch1/hit", kev=energies[order], **{key: numbers[order]})
    found = open_pulses(raw, energy=f"{hit}:ch1/hit/energy").read()
    wanted = energies.copy()
    wanted[np.setdiff1d(np.arange(N), order)] = np.nan
    np.testing.assert_array_equal(found.energy_kev, wanted)
    assert any(f"joined by {key}, 10 of {N}" in message for message in caplog.messages)
    write_table(hit, "ch1/other", kev=energies, **{key: numbers + N})
    with pytest.raises(CpunetError, match="of other events"):
        open_pulses(raw, energy=f"{hit}:ch1/other/energy")


@pytest.mark.parametrize("bits", [12, 14, 16])
@pytest.mark.parametrize("signed", [True, False])
def test_counts_that_roll_over_are_named_and_unwrapped(tmp_path, bits, signed):
    period, energies = 2**bits, kev()
    counts = np.round(traces(energies) * (0.8 if signed else 1.2) * period / 12_500)
    wrapped = (counts + signed * period / 2) % period - signed * period / 2
    assert f"jump by {period} =" in rolled_over(wrapped).text
    assert rolled_over(np.unwrap(wrapped, period=period)) is None
    file = written(tmp_path / "raw.lh5", wrapped, energies)
    selection = parse_selection("1000-", {})
    with pytest.raises(CpunetError, match=rf"jump by {period} = 2\^{bits} .*period={period}"):
        load_pulses(file, "measured", load_recipe("fast"), selection)


@pytest.mark.parametrize("kind", ["int16", "uint16", "uint32"])
def test_the_advice_on_counts_that_roll_over_works_on_integers(tmp_path, kind):
    """`numpy.unwrap` keeps their type: https://github.com/numpy/numpy/pull/29507."""
    counts = traces(kev()).astype(np.int64)
    stored = (3 * counts if kind == "int16" else counts - 5000).astype(kind)
    if kind == "uint16":  # the baseline was subtracted in the digitiser's own type
        stored = counts.astype(kind) - counts[:, :1].astype(kind)
    file = written(tmp_path / "raw.lh5", stored, kev())
    with pytest.raises(CpunetError, match="roll") as error:
        load_pulses(file, "measured", RECIPE, FEP)
    advice = re.search(r"numpy(\.unwrap\(.*\))", str(error.value))
    whole = eval(f"np{advice[1]}", {"np": np, "values": stored, "float": float})
    heights = np.ptp(whole, axis=1) / np.ptp(counts, axis=1)
    np.testing.assert_allclose(heights, 3 if kind == "int16" else 1)
    assert ("view('uint16')" in str(error.value)) == (kind == "int16")


def charge(n: int = 40) -> np.ndarray:
    """Charge that is collected from sample 300 on, in steps as of several sites."""
    rng = np.random.default_rng(3)
    arrival = rng.uniform(300, 400, (n, 2, 1))
    sites = 1 / (1 + np.exp(-(TIME - arrival) / rng.uniform(2, 9, (n, 2, 1))))
    return sites.mean(axis=1)


def adc(pulses: np.ndarray, noise: float = 8.0, gain: float = 30_000.0) -> np.ndarray:
    """Counts behind a decay of 50 µs, with a baseline and noise."""
    rng = np.random.default_rng(4)
    decayed = pulses * np.exp(-np.maximum(TIME - 350, 0) * 16 / 50_000)
    return np.round(9000 + gain * decayed + rng.normal(0, noise, pulses.shape))


@pytest.mark.parametrize(
    ("pulses", "side"),
    [
        (charge(), "simulated"),
        (np.round(1e4 * charge()), "simulated"),  # as siggen stores them
        (adc(charge()), "measured"),
        (adc(charge(), noise=1.0), "measured"),
        (adc(charge(), gain=300.0), "measured"),  # 30 keV
        (charge() + np.random.default_rng(1).normal(0, 1e-3, (40, 800)), None),
        (adc(charge()) / 3e4, None),  # scaled: may be a simulation with noise
        (charge() * np.exp(-TIME / 3000), None),  # a simulated readout
        (charge()[:, :50], None),
        (np.full((5, 800), np.nan), None),
        (np.empty((0, 800)), None),
    ],
)
def test_the_look(pulses, side):
    found = apparent_side(pulses)
    assert (found and found.side) == side


def source_of(path, waveforms, **attrs):
    with PulseWriter(path, attrs=attrs) as writer:
        writer.append(Pulses.of(waveforms, dt_ns=16))
    return open_pulses(path)


@pytest.mark.parametrize(
    ("attrs", "side"),
    [
        ({"translated_by": "cpunet ren"}, "measured"),
        ({"translated_by": "cpunet iren"}, "simulated"),
        ({"made_by": "cpunet simulate 0.1.0"}, "simulated"),
        ({"made_by": "cpunet stand 0.1.0", "side": "simulated"}, "simulated"),
        ({"made_by": "cpunet stand 0.1.0", "side": "measured"}, "measured"),
        ({"made_by": "cpunet stand 0.1.0"}, None),  # an older stand: by its look
        ({}, None),
    ],
)
def test_what_a_file_says(tmp_path, attrs, side):
    found = recorded_side(source_of(tmp_path / "pulses.lh5", charge(), **attrs))
    assert (found and found.side) == side


def test_a_guess_can_be_overruled_and_a_record_cannot(tmp_path):
    looks = source_of(tmp_path / "looks.lh5", adc(charge()))
    require_side(looks, "measured", "swap them", insist=False)
    require_side(looks, "simulated", "swap them", insist=True)
    with pytest.raises(CpunetError) as refused:
        require_side(looks, "simulated", "swap them", insist=False)
    assert str(refused.value) == (
        f"{tmp_path / 'looks.lh5'}: given as simulated pulses, but these look measured (whole "
        "numbers with noise before the pulse); swap them; if they are simulated, say so with "
        "`insist`"
    )
    says = source_of(tmp_path / "says.lh5", adc(charge()), made_by="cpunet simulate 0.1.0")
    require_side(says, "simulated", "swap them", insist=False)
    with pytest.raises(CpunetError, match=r"simulated by cpunet simulate 0\.1\.0; swap them$"):
        require_side(says, "measured", "swap them", insist=True)
