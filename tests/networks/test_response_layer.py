"""The chain against the exact one of the test stands; its inverse with known weights."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.readout import linear_response
from cpunet.networks import generators
from cpunet.networks.generators import LinearInverse
from cpunet.networks.response_layer import DriftClock, ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import ResponseConfig
from synthetic import PADDING_AFTER, PADDING_BEFORE, load_recipe

DT_NS, FINE_PER_SAMPLE, SAMPLES, END = 16.0, 16, 800, 400
# of 12, 20, 12 to 8, and 8 samples
STRETCHES = {"before_ns": 192, "after_ns": 320, "baseline_ns": (192, 128), "level_ns": 128}


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


def edges(*starts: int) -> npt.NDArray[np.float32]:
    """Ramps of four samples from 0 to 1."""
    time = np.arange(60, dtype=np.float32)
    return np.stack([((time - start) / 4).clip(0, 1) for start in starts])


def test_it_gives_back_what_it_gets_about_the_half_maximum_and_0_and_1_beyond(monkeypatch):
    monkeypatch.setattr(generators, "AFTER_NS", 128.0)
    config = load_recipe("fast").matching.training.model_copy(update=STRETCHES)
    identity = LinearInverse(60, config)
    identity.half_height[...] = 0.5
    identity.weights[...] = np.eye(20)
    pulses = 0.9 * edges(25, 30, 33) + np.float32(0.05)  # of any offset and height
    pulses[0, :5] += 0.2
    pulses[0, 55:] -= 0.3
    pulses[1] = float("nan")  # has nothing to say to others
    result = identity(pulses)
    assert result.dtype == np.float32
    assert np.isnan(result[1]).any()
    np.testing.assert_allclose(result[[0, 2]], edges(25, 33), atol=1e-5, rtol=1e-5)
