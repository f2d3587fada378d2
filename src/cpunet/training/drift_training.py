"""Train the U-Net before a learned readout, and keep as much of it as held-out pulses gain.

What the U-Net does (`cpunet.networks.learned_response.DriftUNet`) changes the simulated pulses
so that the moments of both sides agree.  It is trained by Adam on batches of pulses, in rounds;
after each, the step response follows by Gauss-Newton.  A penalty keeps it near the simulation,
a stronger one alike for all pulses.  A fifth of the pulses of both sides is held out of all
that.  Their moments decide whether the whole, half or nothing of what the network does is kept:
nothing unless the gain is beyond two errors by bootstrap.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cpunet.networks.learned_response import DriftUNet, LearnedResponse
from cpunet.training.differentiable import DifferentiableSet
from cpunet.training.fitter import Fitter
from cpunet.training.moments import BLOCK
from cpunet.training.response_problem import Band, Comparison, ResponseProblem

HELD_OUT = 0.2  # fraction of the pulses
ROUNDS, STEPS, BATCH, RATE = 4, 40, 192, 1e-3
BETAS, WEIGHT_DECAY, MEMORY, WARM_UP = (0.5, 0.99), 1e-2, 0.9, 10
# Penalties of the mean of rates and blurs, and of their deviations from it between pulses, in
# units of a typical logarithm of the rate, and of a variance of one sample.
OF_MEAN, OF_PULSES, TYPICAL = 0.05, 1.0, 0.05
SHARES = (0.0, 0.5, 1.0)
RESAMPLED, SURE = 200, 2.0


@dataclass(frozen=True)
class DriftFit:
    """What the U-Net gains on held-out pulses.

    Parameters
    ----------
    share
        How much of it is kept.
    mismatch
        Chi-square per moment of the held-out pulses for shares of 0, 1/2 and 1.
    error
        Errors of the differences from the first of these.
    log_rate, log_rate_spread
        Mean and spread of the logarithm of the clock's rate.
    blur_ns
        Root of the mean variance of the blur in ns, negative for pulses that are sharpened.
    """

    share: float
    mismatch: list[float]
    error: list[float]
    log_rate: float
    log_rate_spread: float
    blur_ns: float

    def __str__(self) -> str:
        shares = ", ".join(f"{share:g}" for share in SHARES)
        found = ", ".join(f"{value:.2f}" for value in self.mismatch)
        kept = f"{100 * self.share:.0f} % of it is kept" if self.share else "it is left out"
        return (
            f"U-Net before the readout: {kept} (chi-square per moment of held-out pulses for "
            f"shares {shares}: {found} ± {max(self.error):.2f}); its clock runs "
            f"{100 * math.expm1(self.log_rate):+.1f} ± {100 * self.log_rate_spread:.1f} %, "
            f"blur {self.blur_ns:+.0f} ns"
        )


def changed(bands: Sequence[Band], drift: DriftUNet | None) -> list[Band]:
    """Bands whose simulated pulses are those that enter the readout."""
    if drift is None:
        return list(bands)
    out = []
    for band in bands:
        sim = band.sim
        with torch.no_grad():
            parts = [
                drift.eval()(torch.from_numpy(np.array(sim.sim[first : first + BLOCK])))
                for first in range(0, len(sim), BLOCK)
            ]
        out.append(replace(band, sim=replace(sim, sim=torch.cat(parts).numpy())))
    return out


def fit_drift(
    response: LearnedResponse,
    bands: Sequence[Band],
    wide: Sequence[Band],
    fitter: Fitter,
    seed: int,
) -> DriftFit:
    """Train the U-Net in front of a fitted readout, which gets as much of it as is kept.

    Parameters
    ----------
    response
        Readout fitted without it.
    bands, wide
        Pulses to train on, with narrow and wide bins of the current amplitude.
    fitter
        Fitter of the step response.
    seed
        Seed of the batches and the held-out pulses.
    """
    rng = np.random.default_rng(seed)
    split = [_split(band, rng) for band in bands]
    known, held = [one for one, _ in split], [other for _, other in split]
    first = [_split(band, np.random.default_rng(seed))[0] for band in wide]
    drift = DriftUNet(response.config.width, float(response.dt_ns))
    step = response.step
    without = copy.deepcopy(step)
    trained = [_Trained(band, response) for band in known]
    optimiser = torch.optim.AdamW(drift.parameters(), RATE, BETAS, weight_decay=WEIGHT_DECAY)
    for number in range(ROUNDS):
        _train(drift, trained, optimiser, number * STEPS, rng)
        for some in (first, known):  # wide bins first
            fitter.follow(ResponseProblem(step, changed(some, drift), draws=1))
    ends = torch.stack([without.coordinates.detach(), step.coordinates.detach()])
    results = []
    for share in SHARES:
        drift.share.fill_(share)
        step.coordinates.data.copy_(torch.lerp(ends[0], ends[1], share))
        if 0 < share < 1:
            fitter.follow(ResponseProblem(step, changed(known, drift), draws=1))
        results.append(_HeldOut(changed(held, drift), known, response))
    chosen, mismatch, error = _chosen(results, seed)
    drift.share.fill_(1.0)
    with torch.no_grad():
        pulses = torch.from_numpy(np.array(bands[0].sim.sim[:BLOCK]))
        _, log_rate, blur = drift.changed(pulses)
    variance = float(blur.mean())
    drift.share.fill_(SHARES[chosen])
    step.coordinates.data.copy_(torch.lerp(ends[0], ends[1], SHARES[chosen]))
    if chosen:
        response.drift = drift
        response.config = response.config.model_copy(update={"drift": True})
    return DriftFit(
        SHARES[chosen],
        mismatch,
        error,
        float(log_rate.mean()),
        float(log_rate.std()),
        math.copysign(math.sqrt(abs(variance)) * float(response.dt_ns), variance),
    )


def _split(band: Band, rng: np.random.Generator) -> tuple[Band, Band]:
    """A band without a part of its pulses, and that part."""
    moments = band.moments
    sim, data = (rng.permutation(n) for n in (len(band.sim), len(moments.data)))
    kept, held = [], []
    for rows in (sim, data):
        n = round(HELD_OUT * len(rows))
        kept.append(np.sort(rows[n:]))
        held.append(np.sort(rows[:n]))
    parts = []
    for of_sim, of_data in (kept, held):
        own = replace(moments, data=moments.data[of_data], values=moments.values[of_data])
        part = replace(band.sim.of(of_sim), moments=own)
        parts.append(Band(band.name, part, band.rows[of_sim]))
    return parts[0], parts[1]


class _Trained:
    """A band that the U-Net is trained on."""

    def __init__(self, band: Band, response: LearnedResponse) -> None:
        self.band, self.response, self.set = band, response, DifferentiableSet(band.sim)
        comparison = Comparison(band)
        self.whiten = torch.from_numpy(comparison.whiten / comparison.sigma)
        self.wanted = torch.from_numpy(comparison.wanted)
        self.mean: Tensor | None = None  # over the last batches

    def chi_square(self, drift: DriftUNet, rng: np.random.Generator) -> tuple[Tensor, ...]:
        """Chi-square per moment, logarithms of the rate, and variances of the blur."""
        sim = self.band.sim
        rows = np.sort(rng.permutation(len(sim))[:BATCH])
        pulses, log_rate, blur = drift.changed(torch.from_numpy(np.array(sim.sim[rows])))
        batch = DifferentiableSet(replace(sim.of(rows)))
        spectra = batch.spectra(pulses)
        with torch.no_grad():
            transfer = self.response.step.transfer(batch.padded).to(torch.complex64)
        clean = batch.scaled(batch.records(spectra, transfer))
        draw = int(rng.integers(len(sim.noise.factor)))
        noisy = clean + batch.noise(draw, 0, len(rows))
        values = batch.readings.functions(*batch.readings(noisy))
        mean = (batch.weights @ values / batch.weights.sum()).double()
        now = mean.detach()
        self.mean = now if self.mean is None else MEMORY * self.mean + (1 - MEMORY) * now
        apart = self.whiten @ (self.mean + mean - now - self.wanted)
        return apart.square().mean(), log_rate, blur


def _train(
    drift: DriftUNet,
    bands: Sequence[_Trained],
    optimiser: torch.optim.Optimizer,
    first: int,
    rng: np.random.Generator,
) -> None:
    """Steps of Adam, with a rate that falls over all rounds."""
    drift.train()
    for band in bands:
        band.mean = None  # the step response has moved
    for number in range(STEPS):
        falling = 0.5 * (1 + math.cos(math.pi * (first + number) / (ROUNDS * STEPS)))
        for group in optimiser.param_groups:
            group["lr"] = RATE * falling * min(1.0, (number + 1) / WARM_UP)
        loss = torch.zeros((), dtype=torch.float64)
        for band in bands:
            chi_square, log_rate, blur = band.chi_square(drift, rng)
            loss = loss + chi_square
            for values, unit in ((log_rate, TYPICAL), (blur, 1.0)):
                mean = values.mean(dim=0)
                loss = loss + OF_MEAN * (mean / unit).square().mean()
                loss = loss + OF_PULSES * ((values - mean) / unit).square().mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()


class _HeldOut:
    """Functions of held-out pulses, from which chi-square follows for any sample of them."""

    def __init__(
        self, bands: Sequence[Band], known: Sequence[Band], response: LearnedResponse
    ) -> None:
        self.sides = [
            (DifferentiableSet(band.sim).values(response.step), band.moments.values)
            for band in bands
        ]
        # the covariance of those that were trained on, which are more
        self.comparisons = [Comparison(band) for band in known]
        self.scales = [held.pairs / band.pairs for held, band in zip(bands, known, strict=True)]

    def chi_square(self, rng: np.random.Generator | None = None) -> float:
        """Per moment, of all pulses or of pulses drawn from them with replacement."""
        total, n = 0.0, 0
        for sides, of, scale in zip(self.sides, self.comparisons, self.scales, strict=True):
            simulated, measured = (
                side.mean(axis=0)
                if rng is None
                else side[rng.integers(len(side), size=len(side))].mean(axis=0)
                for side in sides
            )
            white = of.whiten @ ((simulated - measured) / of.sigma)
            total, n = total + scale * float(white @ white), n + len(white)
        return total / n


def _chosen(held: Sequence[_HeldOut], seed: int) -> tuple[int, list[float], list[float]]:
    """Index of the share to keep; chi-squares; errors of their differences from the first."""
    found = [one.chi_square() for one in held]
    drawn = np.array(
        [
            [one.chi_square(np.random.default_rng((seed, draw))) for one in held]
            for draw in range(RESAMPLED)
        ]
    )
    errors = (drawn - drawn[:, :1]).std(axis=0)
    sure = found[0] - np.array(found) > SURE * errors
    best = int(np.argmin(np.where(sure, found, found[0])))
    return best, found, errors.tolist()
