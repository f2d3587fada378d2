"""Raw traces against what is known of them."""

from __future__ import annotations

import numpy as np
import pytest

from cpunet.electronics.chain import Electronics, NoiseSpectrum, read_electronics
from cpunet.electronics.readout import (
    RawTraces,
    coloured_noise,
    cut_noise,
    draw_other_pulses,
    noise_power,
    read_baselines,
    read_out,
)
from cpunet.electronics.tails_law import TailsLaw
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.writing import write_pulses

N = 300
QUIET = read_electronics("ornl").noise.spectrum


def changed(name: str = "legend200", **values: object) -> Electronics:
    return read_electronics(name, values)


def rates(rate_kHz: float = 0.0, pile_up_kHz: float = 0.0) -> dict[str, object]:
    """Rates of other pulses."""
    return {"earlier_pulses": {"rate_kHz": rate_kHz}, "pile_up": {"rate_kHz": pile_up_kHz}}


@pytest.fixture(scope="module")
def pulses() -> Pulses:
    rng = np.random.default_rng(1)
    ramps = np.clip(np.arange(900) / rng.uniform(40, 120, (N, 1)), 0, 1)
    return Pulses.of(ramps, dt_ns=4, energy_kev=rng.uniform(500, 2614.5, N))


@pytest.fixture(scope="module")
def traces(pulses: Pulses) -> RawTraces:
    return read_out(pulses, read_electronics("ornl"), seed=3)


def test_noise_has_the_spectrum_asked_for():
    line = {"frequency_MHz": 10, "power_fraction": 0.1}
    spectrum = NoiseSpectrum(
        corner_MHz=8.5, order=3, excess=10, excess_corner_kHz=30, lines=(line,)
    )
    noise = coloured_noise(spectrum, 2000, 8192, 16, np.random.default_rng(2))
    assert noise.std() == pytest.approx(1, rel=0.01)
    measured = (np.abs(np.fft.rfft(noise)) ** 2).mean(axis=0)
    measured[1:-1] *= 2  # negative frequencies
    expected = noise_power(spectrum, 16, 8192)
    edges = np.unique(np.geomspace(1, 4096, 30).astype(int))
    ratio = np.add.reduceat(measured / measured[1:].sum(), edges) / np.add.reduceat(
        expected, edges
    )
    assert np.abs(ratio - 1).max() < 0.05


def test_noise_cut_from_baselines_is_theirs(tmp_path):
    path = tmp_path / "baselines.lh5"
    white = 14000 + np.random.default_rng(4).normal(0, 7, (50, 2000))
    write_pulses(path, Pulses.of(white, dt_ns=16, energy_kev=np.zeros(50)))
    baselines = read_baselines(path, 1200, 16)
    cut = cut_noise(baselines, 200, 1200, np.random.default_rng(5))
    assert cut.std() == pytest.approx(1, rel=0.02)
    kev = changed(noise={"rms_kev": 2.0, "baselines_file": path})
    steps = Pulses.of(np.ones((20, 900)), dt_ns=4, energy_kev=np.full(20, 1000.0))
    level = read_out(steps, kev, seed=1).waveforms[:, :400].std() / kev.gain_adc_per_kev
    assert level > 1.9
    with pytest.raises(CpunetError, match="shorter than the record"):
        read_baselines(path, 2001, 16)
    white[17, 3] = np.nan
    write_pulses(tmp_path / "broken.lh5", Pulses.of(white, dt_ns=16, energy_kev=np.zeros(50)))
    with pytest.raises(CpunetError, match="baseline 17 is not finite; leave it out"):
        read_baselines(tmp_path / "broken.lh5", 1200, 16)


def test_clean_traces_are_baseline_gain_and_response(pulses: Pulses):
    quiet = changed(
        noise={"rms_kev": 0.0, "spectrum": read_electronics("ornl").noise.spectrum},
        earlier_pulses={"rate_kHz": 0.0},
        pile_up={"rate_kHz": 0.0},
    )
    traces = read_out(pulses, quiet, seed=3)
    height = quiet.gain_adc_per_kev * traces.true_energy_kev[:, None]
    expected = traces.baseline_adc[:, None] + height * traces.response
    assert np.abs(traces.waveforms - expected).max() <= 0.51
    assert not traces.flags.any()


def test_shares_of_disturbed_traces(traces: RawTraces):
    law = TailsLaw(1.5, 54.6, read_electronics("ornl").other_pulses_kev)
    assert np.mean(traces.flags & 1 > 0) == pytest.approx(law.share_above(0.98), abs=0.09)
    often = changed("ornl", pile_up={"rate_kHz": 36.1})
    steps = Pulses.of(np.ones((N, 900)), dt_ns=4, energy_kev=np.full(N, 1000.0))
    piled = np.mean(read_out(steps, often, seed=1).flags & 2 > 0)
    assert piled == pytest.approx(0.5, abs=0.1)  # 1 - exp(-36.1 kHz x 19.2 us)


def test_tails_follow_the_law_and_all_decays_of_the_chain():
    chain = changed("ornl", length=1200, **rates(3))
    steps = Pulses.of(np.ones((4000, 10)), dt_ns=4, energy_kev=np.full(4000, 1000.0))
    other = draw_other_pulses(steps, chain, np.random.default_rng(1))
    law = TailsLaw(3, 54.6, chain.other_pulses_kev)
    above = [5, 20, 100, 500]
    found = [(other.tails_kev > kev).mean() for kev in above]
    # several tails add up, and a twentieth of each charge decays early
    assert found == pytest.approx(law.share_above(above), rel=0.12, abs=0.01)
    assert other.tails_kev.mean() == pytest.approx(0.953 * law.mean_kev, rel=0.1)
    old = other.added_kev[other.tails_kev > 100]
    ratio = np.median(old[:, 1000] / old[:, 0])
    assert ratio == pytest.approx(np.exp(-16 / 54.6), rel=0.01)
    assert (old[:, 1000] / old[:, 0]).min() < 0.97 * ratio  # of pulses a few us before


def test_piled_up_pulses_are_where_the_truth_says():
    quiet = {"noise": {"rms_kev": 0.0, "spectrum": QUIET}, "trigger_jitter_ns": 200}
    chain = changed("ornl", **quiet, **rates(0, 30))
    steps = Pulses.of(np.ones((200, 900)), dt_ns=4, energy_kev=np.full(200, 1000.0))
    traces = read_out(steps, chain, seed=2)
    alone = np.flatnonzero((traces.n_piled == 1) & (traces.piled_ns > 1000))
    assert len(alone) > 10
    adc = chain.gain_adc_per_kev
    own = adc * traces.true_energy_kev[:, None] * traces.response
    rest = (traces.waveforms - traces.baseline_adc[:, None] - own)[alone] / adc

    def rise_ns(rows: np.ndarray) -> np.ndarray:
        """Interpolated time at which the traces rise through 0.3 of their maxima."""
        level = 0.3 * rows.max(axis=1)
        after = (rows > level[:, None]).argmax(axis=1)
        low, high = (rows[np.arange(len(rows)), at] for at in (after - 1, after))
        return chain.dt_ns * (after - (high - level) / (high - low))

    assert rise_ns(rest) - rise_ns(own[alone]) == pytest.approx(traces.piled_ns[alone], abs=5)
    assert rest.max(axis=1) == pytest.approx(traces.piled_kev[alone], rel=0.03)
    assert np.isnan(traces.piled_kev[traces.n_piled == 0]).all()


def test_hum_is_a_wave_of_its_size():
    hum = {"frequency_Hz": 50, "amplitude_kev": 30}
    noise = {"rms_kev": 0.0, "spectrum": QUIET}
    chain = changed("ornl", noise=noise, hum=hum, **rates())
    steps = Pulses.of(np.ones((400, 900)), dt_ns=4, energy_kev=np.full(400, 1000.0))
    traces = read_out(steps, chain, seed=2)
    level = traces.waveforms[:, :400].mean(axis=1) - traces.baseline_adc
    assert level.std() == pytest.approx(30 * chain.gain_adc_per_kev / 2**0.5, rel=0.1)


def test_wandering_is_recovered_from_levels_and_their_changes():
    noise, wander = {"rms_kev": 0.0, "spectrum": QUIET}, {"time_us": 200, "rms_kev": 20}
    chain = changed("ornl", noise=noise, wander=wander, **rates())
    steps = Pulses.of(np.ones((400, 900)), dt_ns=4, energy_kev=np.full(400, 1000.0))
    traces = read_out(steps, chain, seed=2)
    level = (traces.waveforms - traces.baseline_adc[:, None]) / chain.gain_adc_per_kev
    first, later = level[:, 0], level[:, 450]
    assert first.std() == pytest.approx(20, rel=0.1)
    # 2 sigma^2 (1 - exp(-t / T)) after 7.2 us
    change = 20 * np.sqrt(2 * -np.expm1(-7.2 / 200))
    assert (later - first).std() == pytest.approx(change, rel=0.12)
    # all else is drawn as without it
    quiet = changed("ornl", noise=noise, **rates())
    plain = read_out(steps, quiet, seed=2)
    assert np.array_equal(plain.energy_kev, traces.energy_kev)
    assert np.array_equal(plain.response, traces.response)


def test_saturation_is_flagged_and_clipped(pulses: Pulses):
    traces = read_out(pulses, changed(gain_adc_per_kev=40), seed=1)
    saturated = traces.flags & 4 > 0
    assert (traces.waveforms.max(axis=1)[saturated] == 65535).all()
    assert saturated.any()
    assert not saturated[traces.true_energy_kev < 1000].all()


def test_energies_have_the_resolution(pulses: Pulses):
    line = Pulses.of(np.ones((4000, 1)), dt_ns=4, energy_kev=np.full(4000, 2614.5))
    short = changed(length=40, n_pre=10)
    assert 2.355 * read_out(line, short, seed=1).energy_kev.std() == pytest.approx(
        2.6, rel=0.05
    )


def test_pulses_without_energy_are_named():
    steps = Pulses.of(np.ones((1, 9)), dt_ns=4, event_number=[71])
    with pytest.raises(CpunetError, match="event 71"):
        read_out(steps, read_electronics("ornl"), seed=1)
