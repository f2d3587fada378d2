"""Unpaired sets of pulses, one of which went through a chain of known numbers.

Their alignment at half maximum is in plain arrays: what compiled loops are compared with.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.readout import coloured_noise, linear_response
from cpunet.networks.generators import stretch
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import MatchingConfig
from synthetic import drifting, load_recipe, two_sites

Floats = npt.NDArray[np.floating]
Ints = npt.NDArray[np.integer]
DT_NS, FINE_NS, FINE_PER_SAMPLE = 16.0, 2.0, 8
KEV, NOISE_KEV = 2614.5, 1.95
N = 600
# Slow part and decays are such that the response can describe the chain exactly.
CHAIN = Electronics.model_validate(
    read_electronics("legend200").model_dump()
    | {
        "bandwidth_poles_ns": (55, 35),
        "slow": {"fraction": 0.065, "tau_ns": 400.0},
        "decays": [{"fraction": 1.0, "tau_us": 80.0}],
    }
)
RECIPE = load_recipe("fast")


def charge(n: int, seed: int, longest: float = 100, steepest: float = 5) -> Pulses:
    """Charge of one or two sites, finely sampled: slow at first, then a steep end.

    `longest` drift and `steepest` end are in samples of the digitiser.
    """
    rng = np.random.default_rng(seed)
    time = (np.arange(240 * FINE_PER_SAMPLE, dtype=np.float32) + 0.5) / FINE_PER_SAMPLE

    def site() -> np.ndarray:
        drift = rng.uniform(10, longest, (n, 1))
        steep = rng.uniform(steepest, steepest + 4, (n, 1))
        return drifting(time - 30 - rng.uniform(0, 1, (n, 1)), drift, steep)

    pulses = two_sites(rng, n, site)
    return Pulses.of(pulses, dt_ns=FINE_NS, energy_kev=np.full(n, KEV))


def coarse(fine: Pulses) -> np.ndarray:
    """Means over the samples of the digitiser."""
    return fine.waveforms.reshape(len(fine), -1, FINE_PER_SAMPLE).mean(axis=2)


def simulated(fine: Pulses) -> Pulses:
    pulses = Pulses.of(coarse(fine), dt_ns=DT_NS, energy_kev=fine.energy_kev)
    return prepare(pulses, RECIPE.preparation, "simulated").pulses


class Unpaired(NamedTuple):
    """Unpaired sets, and the noise as it is measured on one of them."""

    sim: Pulses
    data: Pulses
    noise: BaselineNoise


def measured_with(chain: Electronics, n: int = N) -> Unpaired:
    clean = linear_response(charge(n, seed=2), chain)
    rng = np.random.default_rng(3)
    noise = coloured_noise(chain.noise.spectrum, n, chain.length, DT_NS, rng)
    adc = 15_000 + chain.gain_adc_per_kev * (KEV * clean + NOISE_KEV * noise)
    raw = Pulses.of(np.round(adc), dt_ns=DT_NS, energy_kev=np.full(n, KEV))
    data = prepare(raw, RECIPE.preparation, "measured").pulses
    measured = BaselineNoise.of(Baselines.of([raw], RECIPE.preparation))
    return Unpaired(simulated(charge(n, seed=1)), data, measured)


def faster(fine: Pulses, factor: float) -> Pulses:
    """The same charge, collected in a time shorter by this factor."""
    samples = np.arange(fine.waveforms.shape[1])
    end = (fine.waveforms >= 0.999).argmax(axis=1)
    values = [
        np.interp(at + factor * (samples - at), samples, row)
        for at, row in zip(end, fine.waveforms, strict=True)
    ]
    return fine.with_waveforms(np.array(values, np.float32))


def edge_errors(response: ElectronicsResponse) -> np.ndarray:
    """RMSE on the edge of other pulses than were fitted, against those of the true chain."""
    fine = charge(200, seed=9)
    records = response(simulated(fine).waveforms)
    found, truth = (
        at_half_maximum(one / one.max(), 0.5, 900, RECIPE.matching.training, 0.8)
        for one in (records.astype(float), linear_response(fine, CHAIN))
    )
    training = RECIPE.matching.training
    half = training.samples(training.before_ns)
    edge = slice(half - 100, half + 30)
    return np.asarray(np.sqrt(((found - truth)[:, edge] ** 2).mean(axis=1)))


def crossing(records: Floats, level: float, last: Ints) -> tuple[Floats, Ints]:
    """Last upward crossing of a level before a sample, and the sample before it."""
    index = np.arange(records.shape[1] - 1)
    below = (records[:, :-1] < level) & (index < last[:, None])
    before = np.maximum((below * (index + 1)).max(axis=1) - 1, 0)
    rows = np.arange(len(records))
    low, high = records[rows, before], records[rows, before + 1]
    return before + (level - low) / np.maximum(high - low, 1e-6), before


def at_half_maximum(
    records: Floats, level: float, last: int, config: MatchingConfig, tail_level: float
) -> Floats:
    """Records aligned at a level that is crossed, without baseline, scaled to the tail's level.

    Windows of ``before + after`` samples around the crossing, moved by fractions of a sample.
    """
    _, sample = crossing(records, level, np.full(len(records), last))
    first, stop = map(config.samples, config.baseline_ns)
    before, after, level_samples = (
        config.samples(ns) for ns in (config.before_ns, config.after_ns, config.level_ns)
    )
    # twice, since baseline and level are relative to the crossing of the normalised record
    for _ in range(2):
        base = stretch(records, sample, -first, -stop).mean(axis=1, keepdims=True)
        records = records - base
        tail = stretch(records, sample, after - level_samples, after)
        records = records * (tail_level / tail.mean(axis=1, keepdims=True))
        time, sample = crossing(records, level, sample + 20)
    start = np.floor(time).astype(int)
    fraction = (time - start)[:, None]
    window = stretch(records, start, -before, after + 1)
    return window[:, :-1] * (1 - fraction) + window[:, 1:] * fraction
