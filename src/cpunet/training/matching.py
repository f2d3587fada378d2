"""A readout chain fitted to unpaired pulses: least squares on moments, with errors.

The parameters of a response are those for which the moments of the translated simulation,
noise and all, agree best with those of the data: a chi-square fit in about ten
parameters by the Levenberg–Marquardt method, with derivatives by finite differences on
fixed random numbers.  Its value says whether the response describes the data, its
curvature how well each parameter is known.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.errors import CpunetError
from cpunet.networks.response import ROOM_AFTER, ROOM_BEFORE, ElectronicsResponse
from cpunet.pulses.container import FloatArray
from cpunet.recipes.schema import Recipe, ResponseConfig
from cpunet.training.moments import FEWEST, Moments

Listener = Callable[[int, float], None]

# Half maxima come at most this many samples after the aligned one: what the response delays.
DELAY = 100
# Widths of the priors about the start: wide for times (in their logarithm), and for weights
# such that a chain may be half slow, and that a decay is mostly the main one.
TIME_WIDTH, WEIGHT_WIDTH, DECAY_WIDTH, RINGING_WIDTH = 1.0, 0.1, 0.03, 0.05
TIME_STEP, WEIGHT_STEP = 0.01, 0.002  # of the finite differences
# Far from the data all deviations would be clipped alike, so that first rounds clip later.
FIRST_CLIPS, ROUNDS_EACH = (64.0, 16.0), 4
# Chi-square per moment at which a fit has found its valley; the data's own outliers and the
# ridge keep it from 1.
GOOD_FIT = 1.6
# A wrong valley gives three per moment; this is another detector.
HOPELESS_FIT = 20.0
CONVERGED = 0.05  # fall of chi-square
DAMPING, HARDER, EASIER, TRIES = 0.01, 6.0, 6.0, 6
BLOCK = 512  # pulses at a time, to bound memory


@dataclass(frozen=True)
class Fit:
    """How well a response describes the data.

    Parameters
    ----------
    chi_square, moments
        Of the comparison, and the number of moments compared; before errors of the
        simulation were allowed for, if they were.
    steps
        Steps taken.
    errors
        Standard deviations of the parameters, by name, as their curvature gives them.
    pulls
        Deviation of each moment in its standard deviations, by name.
    data_left_out
        Measured pulses that the moments leave out: a second pulse, or no baseline.
    """

    chi_square: float
    moments: int
    steps: int
    errors: dict[str, float]
    pulls: dict[str, float]
    data_left_out: int


def fit_response(
    sim: FloatArray,
    data: FloatArray,
    energy_kev: np.ndarray[tuple[int], np.dtype[np.float64]],
    noise: BaselineNoise,
    recipe: Recipe,
    *,
    seed: int,
    listener: Listener | None = None,
) -> tuple[ElectronicsResponse, Fit]:
    """Fit a response to unpaired prepared pulses.

    Parameters
    ----------
    sim, data
        Prepared windows, shapes (n, samples) and (n', samples).
    energy_kev
        Of the simulated pulses: the noise goes as its inverse.
    noise
        Of the data's baselines.
    recipe
        With a response to be matched.
    seed
        Of the choice of pulses, if there are many, and of the noise.
    listener
        Told step and chi-square.

    Raises
    ------
    CpunetError
        If there are too few pulses, or the fit does not find a finite chi-square.
    """
    config, training = recipe.matching
    rng = np.random.default_rng(seed)
    if len(sim) < FEWEST:
        raise CpunetError(
            f"{len(sim)} simulated pulses; {FEWEST} or more are needed: select more energies "
            "(--peak) or simulate more"
        )
    sim_rows, data_rows = (
        np.sort(rng.choice(len(side), min(len(side), training.max_pulses), replace=False))
        for side in (sim, data)
    )
    moments = Moments.of_data(data[data_rows], training, recipe.preparation)
    length = ROOM_BEFORE + sim.shape[1] + ROOM_AFTER
    drawn = noise.draw(energy_kev[sim_rows], length, rng)
    if listener is not None:
        listener = _counted(listener)
    best: tuple[_Problem, Fit] | None = None
    for factor in training.start_factors:
        problem = _Problem(
            _start(config, noise.dt_ns, factor, float(moments.slope)),
            moments,
            torch.from_numpy(sim[sim_rows]),
            torch.from_numpy(drawn),
            last=ROOM_BEFORE + recipe.preparation.samples_before + DELAY,
        )
        fit = _levenberg_marquardt(problem, training.steps, listener)
        if best is None or fit.chi_square < best[1].chi_square:
            best = problem, fit
        if not GOOD_FIT <= fit.chi_square / fit.moments <= HOPELESS_FIT:
            break  # no other valley is to be looked for
    assert best is not None  # the recipe has one start at least
    problem, fit = best
    if fit.chi_square >= GOOD_FIT * fit.moments:
        problem.allow_for_model_error()
        again = _levenberg_marquardt(problem, training.steps, listener, coarse=False)
        # its own chi-square says nothing: what does not fit was allowed for
        fit = replace(again, chi_square=fit.chi_square, steps=fit.steps + again.steps)
    return problem.response, fit


def _counted(listener: Listener) -> Listener:
    """A listener told the steps of all fits as one count."""
    steps = itertools.count(1)
    return lambda _, chi_square: listener(next(steps), chi_square)


def _start(
    config: ResponseConfig, dt_ns: float, factor: float, slope: float
) -> ElectronicsResponse:
    """A response with the recipe's poles times a factor, and the data's own decay."""
    response = ElectronicsResponse(config, dt_ns)
    response.log_poles_ns.data.add_(math.log(factor))
    if slope < 0:
        response.log_decay_us.data.fill_(math.log(-dt_ns * 1e-3 / slope))
    return response


class _Problem:
    """Residuals of the moments, and the priors, as functions of a vector of parameters."""

    def __init__(
        self,
        response: ElectronicsResponse,
        moments: Moments,
        sim: Tensor,
        noise: Tensor,
        last: int,
    ) -> None:
        self.response, self.moments = response, moments
        self.sim, self.noise, self.last = sim, noise, last
        self.clip: float | None = None
        named = [(n, p) for n, p in response.named_parameters() if p.numel()]
        self.parameters = [parameter for _, parameter in named]
        self.labels = [n for n, p in named for _ in range(p.numel())]
        self.centre = self.vector()
        widths = {
            "decay_weights": DECAY_WIDTH,
            "ringing": RINGING_WIDTH,
            "slow_weights": WEIGHT_WIDTH,
        }
        times = [label.startswith("log") for label in self.labels]
        self.widths = torch.tensor(
            [widths.get(n, TIME_WIDTH) for n in self.labels], dtype=torch.float64
        )
        self.steps = torch.where(torch.tensor(times), TIME_STEP, WEIGHT_STEP).double()
        values = moments.values
        self.wanted = values.mean(dim=0)
        covariance = torch.cov(values.T) * (1 / len(values) + 1 / len(sim))
        self.sigma = covariance.diagonal().sqrt().clamp_min(1e-12)
        correlation = covariance / self.sigma[:, None] / self.sigma
        ridge = moments.config.ridge
        self.correlation = (1 - ridge) * correlation + ridge * torch.eye(len(correlation))
        self.whiten = torch.linalg.cholesky(torch.linalg.inv(self.correlation)).T

    def allow_for_model_error(self) -> None:
        """Let the moments that physics shape, and electronics do not, count for little.

        If no response makes the sets agree, the simulated physics differ.  The shape of the
        edge would then bend the response to its liking; current amplitude, top and tail
        decide instead, see `Moments.model_errors`.
        """
        correlation = self.correlation + torch.diag(self.moments.model_errors**2)
        self.whiten = torch.linalg.cholesky(torch.linalg.inv(correlation)).T

    def vector(self) -> Tensor:
        """Parameters as one vector."""
        return torch.cat([p.detach().flatten().clone() for p in self.parameters])

    def set(self, vector: Tensor) -> None:
        """Put a vector into the response."""
        first = 0
        for parameter in self.parameters:
            stop = first + parameter.numel()
            parameter.data.copy_(vector[first:stop].view_as(parameter))
            first = stop

    @torch.no_grad()
    def pulls(self, vector: Tensor) -> Tensor:
        """Deviations of the moments in standard deviations, correlated as they are."""
        self.set(vector)
        level = self.moments.preparation.tail_level
        total, n = torch.zeros_like(self.wanted), 0
        for first in range(0, len(self.sim), BLOCK):
            rows = slice(first, first + BLOCK)
            records = self.response(self.sim[rows])
            plateau = records[:, -ROOM_AFTER : -ROOM_AFTER + 100].mean(dim=1, keepdim=True)
            records = records * (level / plateau) + self.noise[rows]
            values = self.moments.of_records(records, self.last, self.clip)
            usable = torch.isfinite(values).all(dim=1)
            total, n = total + values[usable].sum(dim=0), n + int(usable.sum())
        return (total / max(n, 1) - self.wanted) / self.sigma

    def residuals(self, vector: Tensor) -> Tensor:
        """Uncorrelated residuals, and those of the priors."""
        prior = (vector - self.centre) / self.widths
        return torch.cat([self.whiten @ self.pulls(vector), prior])

    def jacobian(self, vector: Tensor, residuals: Tensor) -> Tensor:
        """Derivatives by finite differences, shape (residuals, parameters)."""
        columns = []
        for i, step in enumerate(self.steps):
            moved = vector.clone()
            moved[i] += step
            columns.append((self.residuals(moved) - residuals) / step)
        return torch.stack(columns, dim=1)


def _levenberg_marquardt(
    problem: _Problem, steps: int, listener: Listener | None, *, coarse: bool = True
) -> Fit:
    vector, taken, curvature = problem.vector(), 0, torch.eye(1, dtype=torch.float64)
    rounds = [(clip, ROUNDS_EACH) for clip in FIRST_CLIPS if coarse]
    for clip, most in [*rounds, (None, steps - ROUNDS_EACH * len(rounds))]:
        problem.clip = clip
        residuals, damping = problem.residuals(vector), DAMPING
        cost = float(residuals @ residuals)
        for _ in range(max(1, most)):
            jacobian = problem.jacobian(vector, residuals)
            curvature, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
            for _ in range(TRIES):
                scaled = curvature + damping * torch.diag(curvature.diagonal())
                move = -torch.linalg.solve(scaled, gradient)
                tried = vector + move.clamp(-problem.widths, problem.widths)
                found = problem.residuals(tried)
                if float(found @ found) < cost:
                    break
                damping *= HARDER
            else:
                break
            fall = cost - float(found @ found)
            vector, residuals, cost = tried, found, cost - fall
            damping /= EASIER
            taken += 1
            if listener is not None:
                listener(taken, cost)
            if fall < CONVERGED:
                break
    if not math.isfinite(cost):
        raise CpunetError(
            "the fit of the response diverged; check that the sets hold single pulses of one "
            "detector (cpunet info), or train on other energies (--peak)"
        )
    problem.set(vector)
    pulls = problem.pulls(vector)
    covariance = torch.linalg.inv(curvature)
    return Fit(
        chi_square=cost,
        moments=len(pulls),
        steps=taken,
        errors=_by_name(problem.labels, covariance.diagonal().sqrt()),
        pulls=dict(zip(problem.moments.names, pulls.tolist(), strict=True)),
        data_left_out=problem.moments.left_out,
    )


def _by_name(labels: list[str], values: Tensor) -> dict[str, float]:
    counted: dict[str, int] = {}
    named = {}
    for label, value in zip(labels, values.tolist(), strict=True):
        counted[label] = counted.get(label, 0) + 1
        named[f"{label}.{counted[label]}"] = value
    return named
