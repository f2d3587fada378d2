"""Unpaired sets of pulses, one of which went through a chain of known numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.readout import coloured_noise, linear_response
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.training.aligned import Frame, read
from synthetic import drifting, load_recipe, two_sites

Floats = npt.NDArray[np.floating]
Ints = npt.NDArray[np.integer]
DT_NS, FINE_NS, FINE_PER_SAMPLE = 16.0, 2.0, 8
KEV, NOISE_KEV = 2614.5, 1.95
N = 600
# Slow part and decays are such that the response can describe the chain exactly.
CHAIN = read_electronics(
    "legend200",
    ["bandwidth_poles_ns=[55, 35]", "slow.tau_ns=400", "decays=[{fraction: 1, tau_us: 80}]"],
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
    rows = zip(end, fine.waveforms, strict=True)
    values = [np.interp(at + factor * (samples - at), samples, row) for at, row in rows]
    return fine.with_waveforms(np.array(values, np.float32))


def edge_errors(response: ElectronicsResponse) -> np.ndarray:
    """RMSE on the edge of other pulses than were fitted, against those of the true chain."""
    fine, frame = charge(200, seed=9), Frame(RECIPE.matching.training)
    both = response(simulated(fine).waveforms), linear_response(fine, CHAIN)
    found, truth = (read(np.asarray(records, float), frame).pulses for records in both)
    edge = slice(frame.before - 100, frame.before + 30)
    level = RECIPE.preparation.tail_level  # of prepared pulses
    return np.asarray(level * np.sqrt(((found - truth)[:, edge] ** 2).mean(axis=1)))


def crossing(records: Floats, level: float, last: Ints) -> tuple[Floats, Ints]:
    """Last upward crossing of a level before a sample, and the sample before it."""
    index = np.arange(records.shape[1] - 1)
    below = (records[:, :-1] < level) & (index < last[:, None])
    before = np.maximum((below * (index + 1)).max(axis=1) - 1, 0)
    rows = np.arange(len(records))
    low, high = records[rows, before], records[rows, before + 1]
    return before + (level - low) / np.maximum(high - low, 1e-6), before
