"""Fit the learned readout and the U-Net before it to unpaired pulses: the recipe ``cpunet``.

1. A linear discriminator, solved: the moments that separate the two sides best are those of
   `cpunet.training.moments`; the step response moves until they agree (Gauss-Newton with exact
   derivatives).  Far from the data, narrow bins of the current amplitude are blind, so the
   first bins are wide.  What they find sets the poles of the base for all that follows.
2. Optimal weights (`cpunet.training.optimal_weights`), again and again until nothing moves: all
   fits end in the same response, whatever their noise.
3. If the fit is poor, a ringing is tried, or, if pulses begin differently than simulated, the
   U-Net in front, of which as much is kept as held-out pulses gain.  As a line alone does not
   tell how charge clouds depend on energy, single sites of the continuum are compared, too.

No discriminator network is trained.  What these moments do not see, the classifier of a
validation tells.

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
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cpunet.networks.learned_response import DriftUNet, LearnedResponse, StepResponse
from cpunet.networks.response_layer import current_spectrum
from cpunet.recipes.schema import LearnedConfig
from cpunet.training.differentiable import DifferentiableSet
from cpunet.training.fitter import Fitted, Fitter, HeldOutPulses, compared, split
from cpunet.training.levenberg_marquardt import FIRST_CLIPS
from cpunet.training.moments import BLOCK, Values
from cpunet.training.optimal_weights import refine
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_fit import CHECKED, Fit, described
from cpunet.training.response_problem import Band, BandComparison, ResponseProblem
from cpunet.training.response_starts import RINGS, onset_is_off
from cpunet.training.verdict import verdict

# Width of the bins of the current amplitude and pulses of each side in the first fit from afar,
# and the width in the second.
FIRST_WIDTH, FIRST_PULSES, WIDTH = 0.2, 512, 0.05
POLE_NS = 19.2  # of the base of a step response, times one of the recipe's factors
# Rounds of optimal weights at most, and the move, in widths of the prior, below which they end.
ROUNDS, STILL = 8, 0.15


def fit_learned(
    sets: PulseSets, fitter: Fitter, known: LearnedResponse | None = None
) -> tuple[LearnedResponse, Fit]:
    """Fit a learned readout; parameters as of `cpunet.training.response_fit.fit_response`.

    Of a known readout only the step response is a start: the U-Net is that of other pulses.
    """
    config, training = sets.recipe.matching
    assert isinstance(config, LearnedConfig)
    config = config.model_copy(update={"drift": False})  # a U-Net is trained first
    dt_ns = sets.noise.dt_ns
    far = [band.with_wider_bins(FIRST_WIDTH) for band in sets.bands(FIRST_PULSES)]
    near = [band.with_wider_bins(WIDTH) for band in sets.bands(training.search_pulses)]
    found = None
    if known is not None:
        plain = known.config.model_copy(update={"drift": False})
        response = LearnedResponse(plain, dt_ns)
        response.step.load_state_dict(known.step.state_dict())
        found = fitter.fit(ResponseProblem(response.step, near, draws=1), coarse=False)
    if found is None or found.poor:
        response, found = _from_afar(config, dt_ns, far, near, fitter)
    single: list[Band] = []
    if found.poor and onset_is_off(found.problem):
        if training.drift_terms:
            single = sets.single_sites()
            fit_drift(response, [*sets.bands(CHECKED), *single], fitter)
    elif found.poor and training.ringing_mhz and not response.config.ringing:
        rings = response.config.model_copy(update={"ringing": True})
        other, better = _from_afar(rings, dt_ns, far, near, fitter)
        if better.cost < RINGS * found.cost:
            response = other
    everything = sets.bands()
    if response.drift is None:
        covariance = _determined(response.step, everything, fitter)
    else:
        everything = changed([*everything, *single], response.drift)
        covariance = fitter.follow(ResponseProblem(response.step, everything, 2)).covariance
    checks = verdict(response, sets.sides(response))
    problem = ResponseProblem(response.step, everything)
    return response, described(problem, covariance, checks, fitter)


def _from_afar(
    config: LearnedConfig, dt_ns: float, far: list[Band], near: list[Band], fitter: Fitter
) -> tuple[LearnedResponse, Fitted]:
    """Fit a step response from the best of some bases, first by wide bins."""
    problems = []
    for factor in fitter.training.start_factors:
        problem = ResponseProblem(StepResponse(config, dt_ns), far, draws=1)
        problem.response.set_base(factor * POLE_NS, problem.slope)
        problem.clip = FIRST_CLIPS[-1]  # far from the data, all would be clipped
        problems.append(problem)
    best = min(problems, key=lambda problem: problem.cost)
    fitter.fit(best)
    best.response.set_base(best.response.pole_ns(), best.slope)
    response = LearnedResponse(config, dt_ns)
    response.step = best.response
    return response, fitter.fit(ResponseProblem(response.step, near, draws=1))


def _determined(step: StepResponse, bands: Sequence[Band], fitter: Fitter) -> Values:
    """Move a step response to where optimally weighted means agree; return its covariance."""
    near = ResponseProblem(step, bands)
    for _ in range(ROUNDS):
        before = near.parameters.vector()
        covariance = refine(near, bands, fitter.training.conditional_bins)
        after = near.parameters.vector()
        deviations = near.deviations(after)
        fitter.count(float(deviations @ deviations))
        if np.linalg.norm(after - before) < STILL:
            break
    return covariance


HELD_OUT = 0.2  # fraction of the pulses
DRIFT_ROUNDS, STEPS, BATCH, RATE = 4, 40, 192, 1e-3
BETAS, WEIGHT_DECAY, MEMORY, WARM_UP = (0.5, 0.99), 1e-2, 0.9, 10
# Penalties of the mean of rates and blurs, and of their deviations from it between pulses, in
# units of a typical logarithm of the rate, and of a variance of one sample.
OF_MEAN, OF_PULSES, TYPICAL = 0.05, 1.0, 0.05
SHARES = (0.0, 0.5, 1.0)
UNET = "a U-Net before the readout"


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


def fit_drift(response: LearnedResponse, bands: Sequence[Band], fitter: Fitter) -> None:
    """Train the U-Net in front of a fitted readout, which gets as much of it as is kept.

    Parameters
    ----------
    response
        Readout fitted without it.
    bands
        Pulses to train on.
    fitter
        Fitter of the step response; its seed is that of the network, too.  It is told the gain.
    """
    rng = np.random.default_rng(fitter.seed)
    known, held = split(bands, HELD_OUT, rng)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(fitter.seed)
        drift = DriftUNet(response.config.width, float(response.dt_ns))
    step, without = response.step, response.step.coordinates.detach().clone()
    trained = [_Trained(band, response) for band in known]
    optimiser = torch.optim.AdamW(drift.parameters(), RATE, BETAS, weight_decay=WEIGHT_DECAY)
    for number in range(DRIFT_ROUNDS):
        _train(drift, trained, optimiser, number * STEPS, rng)
        for some in ([band.with_wider_bins(WIDTH) for band in known], known):
            fitter.follow(ResponseProblem(step, changed(some, drift), draws=1))
    whole = step.coordinates.detach().clone()
    results = []
    for share in SHARES:
        drift.share.fill_(share)
        step.coordinates.data.copy_(torch.lerp(without, whole, share))
        if 0 < share < 1:
            fitter.follow(ResponseProblem(step, changed(known, drift), draws=1))
        results.append([HeldOutPulses(changed(held, drift), known, response)])
    gain = compared(results, fitter.seed)
    share = SHARES[gain.best]
    drift.share.fill_(share)
    step.coordinates.data.copy_(torch.lerp(without, whole, share))
    fitter.gains[UNET] = (
        f"{100 * share:.0f} % of it kept; {gain}" if share else f"left out; {gain}"
    )
    if share:
        response.drift = drift
        response.config = response.config.model_copy(update={"drift": True})


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
        spectra = current_spectrum(pulses, batch.padded, sim.dt_ns)
        clean = batch.scaled(batch.records(spectra, transfer))
        draw = int(rng.integers(len(sim.noise.factor)))
        noisy = clean + batch.noise(draw, 0, len(rows))
        values: Any = self.band.moments.functions(batch.readings(noisy))
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
        falling = 0.5 * (1 + math.cos(math.pi * (first + number) / (DRIFT_ROUNDS * STEPS)))
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
