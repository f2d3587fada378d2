"""Train the U-Net before a learned readout, and keep as much of it as held-out pulses gain.

What the U-Net does (`cpunet.networks.learned_response.DriftUNet`) changes the simulated pulses
so that the moments of both sides agree.  It is trained by Adam on batches of pulses, in rounds;
after each, the step response follows by Gauss-Newton.  A penalty keeps it near the simulation,
a stronger one alike for all pulses.  A fifth of the pulses of both sides is held out of all
that.  Their moments decide whether the whole, half or nothing of what the network does is kept:
nothing unless the gain is beyond two errors by bootstrap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cpunet.networks.learned_response import DriftUNet, LearnedResponse
from cpunet.networks.response_layer import current_spectrum
from cpunet.training.differentiable import DifferentiableSet
from cpunet.training.fitter import Fitter, HeldOutPulses, compared, split
from cpunet.training.moments import BLOCK
from cpunet.training.response_problem import Band, BandComparison, ResponseProblem

HELD_OUT = 0.2  # fraction of the pulses
ROUNDS, STEPS, BATCH, RATE = 4, 40, 192, 1e-3
BETAS, WEIGHT_DECAY, MEMORY, WARM_UP = (0.5, 0.99), 1e-2, 0.9, 10
# Penalties of the mean of rates and blurs, and of their deviations from it between pulses, in
# units of a typical logarithm of the rate, and of a variance of one sample.
OF_MEAN, OF_PULSES, TYPICAL = 0.05, 1.0, 0.05
SHARES = (0.0, 0.5, 1.0)
SHOWN = 2048  # pulses that show what it does


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
    longer
        Mean relative change of the time from 2 to 98 % of the charge by all of the network, for
        the quarters of the pulses from the shortest to the longest.
    blur_ns
        Root of the mean variance of the blur in ns, negative for pulses that are sharpened.
    """

    share: float
    mismatch: list[float]
    error: list[float]
    longer: list[float]
    blur_ns: float

    def __str__(self) -> str:
        found = ", ".join(f"{value:.2f}" for value in self.mismatch)
        errors = ", ".join(f"{error:.2f}" for error in self.error[1:])
        longer = ", ".join(f"{100 * value:+.1f}" for value in self.longer)
        kept = f"{100 * self.share:.0f} % of it is kept" if self.share else "it is left out"
        return (
            f"U-Net before the readout: {kept}; chi-square per moment of held-out pulses is "
            f"{found} with none, half and all of it (gains ± {errors}); all of it makes the "
            f"charge of short to long pulses arrive over times longer by {longer} % and blurs "
            f"by {self.blur_ns:+.0f} ns"
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
    response: LearnedResponse, bands: Sequence[Band], wide: float, fitter: Fitter, seed: int
) -> DriftFit:
    """Train the U-Net in front of a fitted readout, which gets as much of it as is kept.

    Parameters
    ----------
    response
        Readout fitted without it.
    bands
        Pulses to train on.
    wide
        Width of bins of the current amplitude by which the step response follows at first.
    fitter
        Fitter of the step response.
    seed
        Seed of the network, its batches and the held-out pulses.
    """
    rng = np.random.default_rng(seed)
    known, held = split(bands, HELD_OUT, rng)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        drift = DriftUNet(response.config.width, float(response.dt_ns))
    step, without = response.step, response.step.coordinates.detach().clone()
    trained = [_Trained(band, response) for band in known]
    optimiser = torch.optim.AdamW(drift.parameters(), RATE, BETAS, weight_decay=WEIGHT_DECAY)
    for number in range(ROUNDS):
        _train(drift, trained, optimiser, number * STEPS, rng)
        for some in ([band.with_wider_bins(wide) for band in known], known):
            fitter.follow(ResponseProblem(step, changed(some, drift), draws=1))
    whole = step.coordinates.detach().clone()
    results = []
    for share in SHARES:
        drift.share.fill_(share)
        step.coordinates.data.copy_(torch.lerp(without, whole, share))
        if 0 < share < 1:
            fitter.follow(ResponseProblem(step, changed(known, drift), draws=1))
        results.append([HeldOutPulses(changed(held, drift), known, response)])
    gain = compared(results, seed)
    chosen = gain.best
    drift.share.fill_(1.0)
    longer, blur_ns = _learned(drift, bands[0])
    drift.share.fill_(SHARES[chosen])
    step.coordinates.data.copy_(torch.lerp(without, whole, SHARES[chosen]))
    if chosen:
        response.drift = drift
        response.config = response.config.model_copy(update={"drift": True})
    return DriftFit(SHARES[chosen], gain.mismatch, gain.error, longer, blur_ns)


def _learned(drift: DriftUNet, band: Band) -> tuple[list[float], float]:
    """What a U-Net does, as `DriftFit` has it."""
    before_ns, longer, blur_ns2 = drift.effect(torch.from_numpy(np.array(band.sim.sim[:SHOWN])))
    quarters = before_ns.argsort().tensor_split(4)
    variance = float(blur_ns2.mean())
    blur_ns = math.copysign(math.sqrt(abs(variance)), variance)
    return [float(longer[rows].mean()) for rows in quarters], blur_ns


class _Trained:
    """A band that the U-Net is trained on."""

    def __init__(self, band: Band, response: LearnedResponse) -> None:
        self.band, self.response = band, response
        comparison = BandComparison(band)
        self.whiten = torch.from_numpy(comparison.whiten / comparison.sigma)
        self.wanted = torch.from_numpy(comparison.wanted)
        self.mean: Tensor | None = None  # over the last batches

    def chi_square(self, drift: DriftUNet, rng: np.random.Generator) -> tuple[Tensor, ...]:
        """Chi-square, logarithms of the rate, and variances of the blur."""
        sim = self.band.sim
        rows = np.sort(rng.permutation(len(sim))[:BATCH])
        pulses, log_rate, blur = drift.changed(torch.from_numpy(np.array(sim.sim[rows])))
        batch = DifferentiableSet(sim.of(rows))
        with torch.no_grad():
            transfer = self.response.step.transfer(batch.padded).to(torch.complex64)
        spectra = current_spectrum(pulses, batch.padded)
        clean = batch.scaled(batch.records(spectra, transfer))
        draw = int(rng.integers(len(sim.noise.factor)))
        noisy = clean + batch.noise(draw, 0, len(rows))
        values = batch.readings.functions(*batch.readings(noisy))
        mean = (batch.weights @ values / batch.weights.sum()).double()
        now = mean.detach()
        self.mean = now if self.mean is None else MEMORY * self.mean + (1 - MEMORY) * now
        apart = self.whiten @ (self.mean + mean - now - self.wanted)
        return apart.square().sum(), log_rate, blur


def _train(
    drift: DriftUNet,
    bands: Sequence[_Trained],
    optimiser: torch.optim.Optimizer,
    first: int,
    rng: np.random.Generator,
) -> None:
    """Steps of Adam, with a rate that falls over all rounds."""
    drift.train()
    moments = sum(len(band.wanted) for band in bands)
    for band in bands:
        band.mean = None  # the step response has moved
    for number in range(STEPS):
        falling = 0.5 * (1 + math.cos(math.pi * (first + number) / (ROUNDS * STEPS)))
        for group in optimiser.param_groups:
            group["lr"] = RATE * falling * min(1.0, (number + 1) / WARM_UP)
        loss = torch.zeros((), dtype=torch.float64)
        for band in bands:
            chi_square, log_rate, blur = band.chi_square(drift, rng)
            loss = loss + chi_square / moments
            for values, unit in ((log_rate, TYPICAL), (blur, 1.0)):
                mean = values.mean(dim=0)
                loss = loss + OF_MEAN * (mean / unit).square().mean()
                loss = loss + OF_PULSES * ((values - mean) / unit).square().mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
