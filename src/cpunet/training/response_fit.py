"""Fit a readout chain to unpaired pulses: least squares on moments, with errors.

The parameters of a response are those for which the moments of the translated simulation,
including noise, agree best with those of the data: a chi-square fit of about ten parameters by
the Levenberg–Marquardt method, with derivatives by finite differences at fixed random numbers.
Some of the pulses are enough to find the valley of chi-square; all of them, optimally weighted,
then determine the response within it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_remains import DrawnRemains, KnownDecay
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import Recipe
from cpunet.recipes.training_settings import MatchingConfig
from cpunet.training.levenberg_marquardt import Listener, Minimum, levenberg_marquardt
from cpunet.training.misfit import amplitude_shift
from cpunet.training.moments import Values
from cpunet.training.optimal_weights import refine
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_problem import Band, ResponseProblem
from cpunet.training.response_starts import (
    GOOD_FIT,
    HOPELESS_FIT,
    best_start,
    drift_if_better,
    drift_if_needed,
    free_decay_if_better,
    from_known,
    is_poor,
    onset_is_off,
    ringing_if_better,
)

# Chi-square per moment above which, with such an onset, nothing else is tried: simulation and
# data are from different detectors.  A ringing missing from the response results in 50.
ANOTHER_DETECTOR = 100.0
# Pulses of each side with which a poor fit is examined.
CHECKED = 4096
# Chi-square per moment above which a fast decay is tried beside a stretch of the drift.
HIDDEN = 1.2
# Rounds of optimal weights; those of the second are evaluated at the result of the first.
ROUNDS = 2


@dataclass(frozen=True)
class Fit:
    """How well a response describes the data.

    Parameters
    ----------
    chi_square, moments
        Chi-square and number of moments of the comparison, before any allowance for errors of
        the simulation.
    steps
        Number of steps taken.
    errors
        Standard deviations of the parameters by name, from the curvature of chi-square.
    pulls
        Deviation of each moment in its standard deviations, by name.
    data_left_out
        Number of measured pulses excluded: those with a second pulse, or without a baseline.
    pairs
        Number of pulses that the errors refer to: the harmonic sum of both sides.
    covariance
        Covariance of the parameters, in the order of `errors`.
    bands
        Energies compared, with the pulses of each side.
    amplitude_shift, amplitude_shift_error
        Relative change of the translated current amplitudes that would bring them closest to
        the data's, see `cpunet.training.misfit`.
    """

    chi_square: float
    moments: int
    steps: int
    errors: dict[str, float]
    pulls: dict[str, float]
    data_left_out: int
    pairs: float
    covariance: list[list[float]]
    bands: dict[str, list[int]]
    amplitude_shift: float
    amplitude_shift_error: float

    @property
    def verdict(self) -> str:
        """Remaining difference between translation and data, in a sentence."""
        shift, error = 100 * self.amplitude_shift, 100 * self.amplitude_shift_error
        off = abs(shift) >= 2 * error
        size = f"the current amplitude is off by {shift:+.2f} ± {error:.2f} %"
        if not off:
            size = f"the current amplitude is right to {abs(shift) + error:.2f} %"
        per = self.chi_square / self.moments
        if self.poor:
            # a shift that is small compared with its error does not make the shape right
            more = f"; {size}" if off else ""
            return f"chi-square is {per:.1f} per moment, too much for chance{more}"
        if per > GOOD_FIT:
            return (
                f"chi-square is {per:.1f} per moment, of a misfit that only so many pulses "
                f"tell; {size}"
            )
        return f"chi-square is {per:.1f} per moment, as by chance; {size}"

    @property
    def poor(self) -> bool:
        """Whether the response does not describe the data.

        With enough pulses any response differs significantly from the true one.  What matters
        then is the misfit relative to the spread of single pulses.
        """
        return self.excess > GOOD_FIT - 1

    @property
    def excess(self) -> float:
        """Chi-square per moment above 1, scaled to `CHECKED` pulses if there are more."""
        return (self.chi_square / self.moments - 1) * min(1.0, 0.5 * CHECKED / self.pairs)


def fit_response(
    sim: Pulses,
    data: Pulses,
    noise: BaselineNoise,
    recipe: Recipe,
    *,
    seed: int,
    known: ElectronicsResponse | None = None,
    remains: DrawnRemains | None = None,
    listener: Listener | None = None,
) -> tuple[ElectronicsResponse, Fit]:
    """Fit a response to unpaired prepared pulses.

    Parameters
    ----------
    sim, data
        Prepared pulses with their energies: noise scales as 1/energy, and pulses are compared
        in bands of energy, see `cpunet.training.energy_bands`.
    noise
        Noise of the data's baselines.
    recipe
        Recipe that matches a response.
    seed
        Seed of the noise, and of the pulses used to search for the valley.
    known
        Response of a similar readout, with the recipe's configuration, to start from.  The
        recipe's own starts are tried only if that fails.
    remains
        Remains of earlier pulses in the data, which are added to the translations.
    listener
        Called with step and chi-square.

    Raises
    ------
    CpunetError
        If there are too few pulses, or the fit does not find a finite chi-square.
    """
    config, training = recipe.matching
    rng = np.random.default_rng(seed)
    sets = PulseSets(sim, data, noise, recipe, rng, remains)
    some = sets.bands(training.search_pulses)
    first = ResponseProblem(ElectronicsResponse(config, noise.dt_ns), some, draws=1)
    if listener is not None:
        listener = _counted(listener)
    told = None if remains is None else remains.known_decay
    near = None if known is None else from_known(first, known, training, told, listener)
    problem, found = near or best_start(first, config, training, told, listener)
    everything = sets.bands()
    if problem.response.drift is None and not is_poor(problem, found):
        fit = _determined(problem, found, everything, training, listener)
        if not fit.poor:
            return problem.response, fit
    elif found.cost > ANOTHER_DETECTOR * problem.moments and onset_is_off(problem, training):
        return problem.response, _with_wrong_physics(problem, found, training, listener)
    problem, found = _checked(problem, sets.bands(CHECKED), training, listener)
    problem, found = _extended(problem, found, training, told, listener)
    if is_poor(problem, found) and onset_is_off(problem, training):
        return problem.response, _with_wrong_physics(problem, found, training, listener)
    return problem.response, _determined(problem, found, everything, training, listener)


def _extended(
    problem: ResponseProblem,
    found: Minimum,
    training: MatchingConfig,
    decay: KnownDecay | None,
    listener: Listener | None,
) -> tuple[ResponseProblem, Minimum]:
    """Extend the response by what brings a poor or stretched fit closer."""
    stretched = problem.response.drift is not None
    if stretched and found.cost < HOPELESS_FIT * problem.moments:  # else a ringing is first
        problem, found = drift_if_better(problem, found, training, listener)
    # a stretch hides some of what another decay does
    if is_poor(problem, found) or (stretched and found.cost > HIDDEN * problem.moments):
        problem, found = free_decay_if_better(problem, found, training, decay, listener)
    if is_poor(problem, found):
        own = problem.response.config
        problem, found = ringing_if_better(problem, found, own, training, listener)
    if stretched or (is_poor(problem, found) and onset_is_off(problem, training)):
        problem, found = drift_if_better(problem, found, training, listener)
        problem, found = drift_if_needed(problem, found, training, listener)
    return problem, found


def _determined(
    problem: ResponseProblem,
    found: Minimum,
    bands: Sequence[Band],
    training: MatchingConfig,
    listener: Listener | None,
) -> Fit:
    """Determine the response within its valley from all pulses.

    Optimal weights trust the shapes of the pulses to a thousandth.  A simulation whose drift
    had to be stretched is not as good as that, so the moments alone are compared there.
    """
    if problem.response.drift is not None:
        whole, end = _checked(problem, bands, training, listener)
        return _fit(whole, end.covariance, found.steps + end.steps)
    compared, steps = ResponseProblem(problem.response, bands), found.steps
    for _ in range(ROUNDS):
        covariance = refine(problem, bands, training.conditional_bins)
        steps += 1
        fit = _fit(compared, covariance, steps)
        if listener is not None:
            listener(steps, fit.chi_square)
    return fit


def _checked(
    problem: ResponseProblem,
    bands: Sequence[Band],
    training: MatchingConfig,
    listener: Listener | None,
) -> tuple[ResponseProblem, Minimum]:
    """Continue the fit with more pulses."""
    more = problem.of(problem.response, bands)
    return more, levenberg_marquardt(more, training.steps, listener, coarse=False)


def _with_wrong_physics(
    problem: ResponseProblem,
    found: Minimum,
    training: MatchingConfig,
    listener: Listener | None,
) -> Fit:
    """Fit with model errors of the simulation, but report the chi-square without them."""
    told = _fit(problem, found.covariance, found.steps)
    problem.allow_for_model_error()
    again = levenberg_marquardt(problem, training.steps, listener, coarse=False)
    fit = _fit(problem, again.covariance, found.steps + again.steps)
    return replace(fit, chi_square=told.chi_square)


def _fit(problem: ResponseProblem, covariance: Values, steps: int) -> Fit:
    """Describe the fit of a response."""
    parameters = problem.parameters
    vector = parameters.vector()
    pulls, deviations = problem.pulls(vector), problem.deviations(vector)
    shift, shift_error = amplitude_shift(problem.response, problem.bands)
    return Fit(
        chi_square=float(deviations @ deviations),
        moments=problem.moments,
        pairs=problem.pairs,
        steps=steps,
        errors=parameters.by_name(np.sqrt(covariance.diagonal())),
        pulls=dict(zip(problem.names, pulls.tolist(), strict=True)),
        data_left_out=problem.left_out,
        covariance=covariance.tolist(),
        bands={b.name: [len(b.sim), len(b.moments.data)] for b in problem.bands},
        amplitude_shift=shift,
        amplitude_shift_error=shift_error,
    )


def _counted(listener: Listener) -> Listener:
    """Make a listener that counts the steps of all fits."""
    steps = itertools.count(1)
    return lambda _, chi_square: listener(next(steps), chi_square)
