"""The chain against the exact one of the stands, its circuits by height, and its inverse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.finishing import finish
from cpunet.electronics.readout import linear_response
from cpunet.errors import CpunetError
from cpunet.networks import generators
from cpunet.networks.by_height import LAG_KNOTS, PER_STEP, ByHeight
from cpunet.networks.generators import LinearInverse
from cpunet.networks.response_layer import DriftClock, ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.reading.files import open_pulses
from cpunet.recipes.schema import ResponseConfig
from cpunet.translation.options import Adc
from cpunet.translation.translate import translate
from cpunet.translation.translator import REN
from synthetic import (
    PADDING_AFTER,
    PADDING_BEFORE,
    edges,
    load_recipe,
    write_chain,
    write_pulses,
)

DT_NS, FINE_PER_SAMPLE, SAMPLES, END = 16.0, 16, 800, 400
# of 12, 20, 12 to 8, and 8 samples
STRETCHES = {"before_ns": 192, "after_ns": 320, "baseline_ns": (192, 128), "level_ns": 128}
KEV, LIMIT = 2000.0, 60.0


def electronics(poles: tuple[float, ...]) -> Electronics:
    """A chain with slow part and fast decay whose times are among the layer's fixed ones."""
    return Electronics.model_validate(
        read_electronics("legend200").model_dump()
        | {
            "bandwidth_poles_ns": poles,
            "slow": {"fraction": 0.065, "tau_ns": 400.0},
            "decays": [{"fraction": 0.96, "tau_us": 80.0}, {"fraction": 0.04, "tau_us": 4.0}],
            "before_ns": DT_NS * PADDING_BEFORE,
            "record_ns": DT_NS * (PADDING_BEFORE + SAMPLES + PADDING_AFTER),
        }
    )


def layer(poles: tuple[float, ...]) -> ElectronicsResponse:
    """The same chain as a layer."""
    config = ResponseConfig(
        name="response",
        poles_ns=poles,
        slow_ns=(100, 400),
        decay_us=80,
        fast_decays_us=(4, 16),
        drift_terms=0,
        deviations=False,
        by_height=False,
    )
    response = ElectronicsResponse(config, DT_NS)
    response.slow_weights[1] = 0.065
    response.sharpness[:] = 0  # the exact chain gives means over a period
    response.decay_weights[0] = 0.04
    return response


def fine_pulses(width_ns: float) -> Pulses:
    """Logistic charge pulses sampled every ns, at three phases of the digitiser's clock."""
    time_ns = np.arange(SAMPLES * FINE_PER_SAMPLE) + 0.5
    start_ns = 3000 + np.array([[0.0], [5.0], [11.0]])
    charge = 1 / (1 + np.exp(-(time_ns - start_ns) / width_ns))
    return Pulses.of(charge, dt_ns=1, energy_kev=np.full(3, 1000.0))


def windows(pulses: Pulses) -> npt.NDArray[np.float32]:
    """Means over the digitiser's period, as the layer takes them."""
    blocks = pulses.waveforms.reshape(len(pulses), -1, FINE_PER_SAMPLE)
    return blocks.mean(axis=2, dtype=float).astype(np.float32)


@pytest.mark.parametrize("poles", [(40.0, 40.0), (55.0, 35.0), (60.0,)])
@pytest.mark.parametrize("width_ns", [10, 20, 80])
def test_finely_simulated_pulses_come_out_as_from_the_exact_chain(poles, width_ns):
    pulses = fine_pulses(width_ns)
    got = layer(poles)(windows(pulses))
    wanted = linear_response(pulses, electronics(poles))
    # 1e-4 is what a decay loses in half a sample: the layer's begins at a sample's edge,
    # 16 ns / 2 / 80 µs. The rest is the spline between the samples: at worst for a single
    # pole, which passes most of what is beyond half the sampling rate, and an edge of 44 ns.
    np.testing.assert_allclose(got, wanted, atol=5e-4)
    top = slice(PADDING_BEFORE + 400, PADDING_BEFORE + 700)
    np.testing.assert_allclose(got[:, top], wanted[:, top], atol=2e-4)


def test_at_a_sharpness_of_one_samples_are_points():
    """Those of the exact chain at the middle of each period, up to 1 ns."""
    pulses, chain = fine_pulses(20), layer((55.0, 35.0))
    exact = electronics((55.0, 35.0)).model_copy(update={"dt_ns": 1.0, "length": 16 * 800})
    fine = linear_response(pulses, exact)
    middle = FINE_PER_SAMPLE // 2
    points = 0.5 * (fine[:, middle - 1 :: 16] + fine[:, middle::16])
    inside = slice(PADDING_BEFORE, PADDING_BEFORE + 600)
    deviations = []
    for sharpness in (0, 1):
        chain.sharpness[:] = sharpness
        records = chain(windows(pulses))[:, inside]
        deviations.append(np.abs(records - points[:, inside]).max())
    assert deviations[1] < 0.2 * deviations[0]


def test_pulses_of_any_height_and_time():
    response = layer((40.0, 40.0))
    pulses = windows(fine_pulses(20))
    assert np.abs(response(pulses)[:, :PADDING_BEFORE]).max() < 2e-5  # nothing wraps around
    later = np.pad(pulses, ((0, 0), (7, 0)))[:, :SAMPLES]
    records, moved = response(pulses), response(3 * later)
    np.testing.assert_allclose(moved[:, 7:-7], 3 * records[:, :-14], atol=1e-5)


def rise(before_us: np.ndarray, long_us: float) -> np.ndarray:
    """Charge by the time before the end, smooth at both of its ends."""
    along = np.clip(1 - before_us / long_us, 0, 1)
    return along**3 * (10 - 15 * along + 6 * along**2)


@pytest.mark.parametrize(("long_us", "a", "b"), [(1, 0.05, 0), (1, -0.05, 0), (2, 0.08, -0.03)])
def test_a_stretched_drift_is_a_longer_one_by_a_factor_that_may_change(long_us, a, b):
    before = 1e-3 * DT_NS * (END - np.arange(800))
    charge = rise(before, long_us)
    clock = DriftClock(2)
    clock.stretch[:] = a, b
    found = clock(charge[np.newaxis].astype(np.float32), dt_ns=DT_NS)[0]
    end = before[(charge >= 0.999).argmax()]  # which stays where it is
    late = np.maximum(before - end, 0)
    expected = rise(before - late + late / (1 + a + b * late), long_us)
    assert np.abs(found - expected).max() < 1e-4
    assert np.abs(found - charge).max() > 100 * 1e-4


def ramps(*starts: int) -> npt.NDArray[np.float32]:
    """Ramps of four samples from 0 to 1."""
    time = np.arange(60, dtype=np.float32)
    return np.stack([((time - start) / 4).clip(0, 1) for start in starts])


def test_it_gives_back_what_it_gets_about_the_half_maximum_and_0_and_1_beyond(monkeypatch):
    monkeypatch.setattr(generators, "AFTER_NS", 128.0)
    config = load_recipe("fast").matching.training.model_copy(update=STRETCHES)
    identity = LinearInverse(60, config)
    identity.half_height[...] = 0.5
    identity.weights[...] = np.eye(20)
    pulses = 0.9 * ramps(25, 30, 33) + np.float32(0.05)  # of any offset and height
    pulses[0, :5] += 0.2
    pulses[0, 55:] -= 0.3
    pulses[1] = float("nan")  # has nothing to say to others
    result = identity(pulses)
    assert result.dtype == np.float32
    assert np.isnan(result[1]).any()
    np.testing.assert_allclose(result[[0, 2]], ramps(25, 33), atol=1e-5, rtol=1e-5)


def slewing() -> ByHeight:
    """An amplifier whose output rises by not much more than `LIMIT` keV per sample."""
    circuit = ByHeight()
    circuit.step_kev[...], circuit.top_kev[...] = 100.0, 1.02 * KEV
    step = 100.0 * np.arange(1, LAG_KNOTS) / PER_STEP / LIMIT
    circuit.lag[1:] = -np.log(np.tanh(step) / step)
    return circuit


def test_a_follower_is_its_recursion() -> None:
    records = edges(5, seed=1).astype(np.float64)
    expected = KEV * records
    for i in range(1, records.shape[1]):
        d = expected[:, i] - expected[:, i - 1]
        expected[:, i] = expected[:, i - 1] + LIMIT * np.tanh(d / LIMIT)
    found = slewing()(records, np.full(5, KEV)) * KEV
    np.testing.assert_allclose(found, expected, atol=1.0)
    assert np.diff(found, axis=1).max() < LIMIT < np.diff(KEV * records, axis=1).max()


def curved() -> ByHeight:
    """A curve whose slope at a height of 0 is 10 %."""
    circuit = ByHeight()
    circuit.top_kev[...] = KEV
    place = np.linspace(0, 1, len(circuit.curve))
    circuit.curve[:] = 0.1 * place * (1 - place)
    return circuit


def test_a_curve_adds_what_the_height_says() -> None:
    """Below zero, a line goes on."""
    records = np.linspace(-0.1, 1.1, 50)[np.newaxis]
    slope = np.where(records < 0, 1, 1 - records.clip(0, 1))
    expected = records + 0.1 * records * slope
    np.testing.assert_allclose(curved()(records, np.array([KEV])), expected, atol=1e-4)


def test_noise_of_baselines_has_passed_the_curve() -> None:
    """So it is the same behind it at a height of zero, and less where the curve is flat."""
    noise = 1e-3 * np.random.default_rng(1).normal(size=(4, 5000))
    for height, slope in ((0.0, 1.0), (0.5, 1 / 1.1)):
        records = np.full(noise.shape, height)
        behind = curved()(records, np.full(4, KEV), noise)
        assert behind.std() == pytest.approx(slope * noise.std(), rel=0.01)


def test_noise_passes_the_amplifier_with_the_pulse() -> None:
    config, pulses = load_recipe("fast").at(16.0).preparation, edges(4, seed=3)
    kev = np.full(4, KEV)
    records = np.pad(pulses, ((0, 0), (200, 400)), mode="edge")
    found = finish(records, config, dt_ns=16.0, energy_kev=kev, by_height=slewing())
    alone = finish(slewing()(records, kev), config, dt_ns=16.0)
    np.testing.assert_array_equal(found.windows, alone.windows)


def test_a_run_stores_what_acts_by_height_and_raw_traces_have_it(tmp_path: Path) -> None:
    """The largest step of a high pulse is limited, that of a low one is not."""
    fill = lambda chain: chain.response.by_height.fill(slewing().arrays())  # noqa: E731
    run = write_chain(tmp_path / "run", "generator.by_height=true", change=fill)
    ren, charge = REN.load(run), edges(4, seed=4)
    with pytest.raises(CpunetError, match="energy_kev"):
        ren.translate(charge, noise=False)
    low, high = (ren.translate(charge, energy_kev=kev, noise=False) for kev in (200.0, KEV))
    assert np.abs(np.diff(low)).max() > 1.05 * np.abs(np.diff(high)).max()
    source, out, kev = tmp_path / "sim.lh5", tmp_path / "out.lh5", np.repeat([200.0, KEV], 4)
    write_pulses(source, Pulses.of(np.tile(charge, (2, 1)), dt_ns=16.0, energy_kev=kev))
    scale = Adc(adc_per_kev=8.0, baseline=1000.0)
    translate(run, source, out, adc=True, scale=scale, noise=False)
    traces = open_pulses(out).read().waveforms.astype(float)
    low, high = np.diff(traces, axis=1).max(axis=1).reshape(2, 4)
    assert high.max() < 8 * 1.1 * LIMIT
    assert (low / 200.0 > 1.05 * high / KEV).all()
