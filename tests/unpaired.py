"""Unpaired sets of pulses, one of which went through a chain of known numbers.

Their alignment at half maximum is in plain tensors: what compiled loops are compared with.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import Electronics, read_electronics
from cpunet.electronics.exact_response import linear_response
from cpunet.electronics.readout import coloured_noise
from cpunet.networks.generators import stretch
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import MatchingConfig
from synthetic import drifting, load_recipe, two_sites

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
    with torch.no_grad():
        records = response(torch.from_numpy(simulated(fine).waveforms))
    found, truth = (
        at_half_maximum(one / one.amax(), 0.5, 900, RECIPE.matching.training, 0.8)
        for one in (records.double(), torch.from_numpy(linear_response(fine, CHAIN)))
    )
    edge = slice(RECIPE.matching.training.before - 100, RECIPE.matching.training.before + 30)
    return (found - truth)[:, edge].square().mean(dim=1).sqrt().numpy()


def crossing(records: Tensor, level: float, last: Tensor) -> tuple[Tensor, Tensor]:
    """Last upward crossing of a level before a sample, by linear interpolation.

    Parameters
    ----------
    records
        Shape (pulses, samples).
    level
        Level that is crossed.
    last
        Sample of each pulse from which the search goes backward, shape (pulses,).

    Returns
    -------
    tuple of Tensor
        Time of each crossing in samples, and the sample before it.
    """
    index = torch.arange(records.shape[1] - 1, device=records.device)
    below = (records[:, :-1] < level) & (index < last[:, None])
    before = ((below * (index + 1)).amax(dim=1) - 1).clamp_min(0)
    low = records.gather(1, before[:, None])[:, 0]
    high = records.gather(1, before[:, None] + 1)[:, 0]
    return before + (level - low) / (high - low).clamp_min(1e-6), before


def at_half_maximum(
    records: Tensor, level: float, last: int, config: MatchingConfig, tail_level: float
) -> Tensor:
    """Align records, subtract the baseline and scale.

    Parameters
    ----------
    records
        Shape (pulses, samples), of about the height of prepared pulses.
    level
        Half of the maximum of the data's mean pulse, the same number for all sets.
    last
        Sample from which the crossing is searched for backward.
    config, tail_level
        Ranges of baseline and level, and the value that the level is scaled to.

    Returns
    -------
    Tensor
        Windows of ``before + after`` samples around the crossing, shifted by fractions of a
        sample.
    """
    whole = torch.full((len(records),), last, device=records.device)
    _, sample = crossing(records, level, whole)
    first, stop = config.baseline
    # twice, since baseline and level are relative to the crossing of the normalised record
    for _ in range(2):
        base = stretch(records, sample, -first, -stop).mean(dim=1, keepdim=True)
        records = records - base
        tail = stretch(records, sample, config.after - config.level_samples, config.after)
        records = records * (tail_level / tail.mean(dim=1, keepdim=True))
        time, sample = crossing(records, level, sample + 20)
    start = time.floor()
    fraction = (time - start)[:, None]
    window = stretch(records, start.long(), -config.before, config.after + 1)
    return window[:, :-1] * (1 - fraction) + window[:, 1:] * fraction
