"""Unpaired sets of pulses, one of which went through a chain of known numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from alignment import at_half_maximum
from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.exact_response import linear_response
from cpunet.electronics.readout import coloured_noise
from cpunet.networks.response_layer import Readout
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes import load_recipe
from synthetic import drifting, two_sites

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


def simulated(fine: Pulses) -> Pulses:
    means = fine.waveforms.reshape(len(fine), -1, FINE_PER_SAMPLE).mean(axis=2)
    pulses = Pulses.of(means, dt_ns=DT_NS, energy_kev=fine.energy_kev)
    return prepare(pulses, RECIPE.preparation, "simulated").pulses


class Unpaired(NamedTuple):
    """Unpaired sets, and the noise as it is measured on one of them."""

    sim: Pulses
    data: Pulses
    noise: BaselineNoise


def measured_with(chain: Electronics) -> Unpaired:
    clean = linear_response(charge(N, seed=2), chain)
    rng = np.random.default_rng(3)
    noise = coloured_noise(chain.noise.spectrum, N, chain.length, DT_NS, rng)
    adc = 15_000 + chain.gain_adc_per_kev * (KEV * clean + NOISE_KEV * noise)
    raw = Pulses.of(np.round(adc), dt_ns=DT_NS, energy_kev=np.full(N, KEV))
    data = prepare(raw, RECIPE.preparation, "measured").pulses
    measured = BaselineNoise.of(Baselines.of([raw], RECIPE.preparation))
    return Unpaired(simulated(charge(N, seed=1)), data, measured)


def faster(fine: Pulses, factor: float) -> Pulses:
    """The same charge, collected in a time shorter by this factor."""
    samples = np.arange(fine.waveforms.shape[1])
    end = (fine.waveforms >= 0.999).argmax(axis=1)
    values = [
        np.interp(at + factor * (samples - at), samples, row)
        for at, row in zip(end, fine.waveforms, strict=True)
    ]
    return fine.with_waveforms(np.array(values, np.float32))


def edge_errors(response: Readout) -> np.ndarray:
    """RMSE on the edge of other pulses than were fitted, against those of the true chain."""
    fine = charge(200, seed=9)
    with torch.no_grad():
        records = response(torch.from_numpy(simulated(fine).waveforms))
    found, truth = (
        at_half_maximum(one / one.amax(), 0.5, 900, RECIPE.matching.training, 0.8)
        for one in (records.double(), torch.from_numpy(linear_response(fine, CHAIN)))
    )
    edge = slice(RECIPE.matching.training.before - 100, RECIPE.matching.training.before + 30)
    return (found - truth)[:, edge].square().mean(dim=1).sqrt().numpy()
