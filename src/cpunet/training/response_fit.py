"""Fit a readout to unpaired pulses: a chain of few parameters, then any step response.

The parameters of a chain are those for which the moments of the translated simulation,
including noise, agree best with those of the data: a chi-square fit of about ten parameters by
the Levenberg–Marquardt method, with exact derivatives at fixed random numbers.
Some of the pulses are enough to find the valley of chi-square; all of them, optimally weighted,
then determine the chain within it.  What no such chain does is learned as deviations of its
step response (`cpunet.training.deviations`), if the pulses ask for them.

Every sample decides whether that is good (`cpunet.training.verdict`).  If it is not, and pulses
begin differently than simulated, the drift of the charges is stretched.

The current amplitude is what users cut on.  How well it is known is also given as the shift of
the current amplitude (A of A/E) that would best match the translated distribution to the data.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.deviations import with_deviations
from cpunet.training.fitter import Fitted, Fitter, held_out_gain
from cpunet.training.moments import Readings, Values
from cpunet.training.optimal_weights import ConditionalFunctions, refine
from cpunet.training.pulse_sets import SINGLE, PulseSets
from cpunet.training.response_problem import Band, ResponseProblem
from cpunet.training.response_starts import (
    drift_if_better,
    drift_if_needed,
    from_known,
    from_start,
    onset_is_off,
)
from cpunet.training.verdict import Verdict, verdict

# Pulses of each side with which a stretch of the drift is examined.
CHECKED = 4096
# Chi-square per sample above which the physics are wrong, if pulses begin otherwise, too.
HOPELESS = 5.0
# Rounds of optimal weights; those of the second are evaluated at the result of the first.
ROUNDS = 2


@dataclass(frozen=True)
class Fit:
    """How well a response describes the data.

    Parameters
    ----------
    checks
        What every sample says.
    chi_square, moments
        Chi-square and number of moments of the comparison, before any allowance for errors of
        the simulation.
    steps
        Number of steps taken, by all fits together.
    errors
        Standard deviations of the parameters by name, from the curvature of chi-square.
    pulls
        Deviation of each moment in its standard deviations, by name.
    data_left_out
        Number of measured pulses excluded: those with a piled-up pulse, or without a baseline.
    pairs
        Number of pulses that the errors refer to: the harmonic sum of both sides.
    covariance
        Covariance of the parameters, in the order of `errors`.
    bands
        Energies compared, with the pulses of each side.
    amplitude_shift, amplitude_shift_error
        Relative change of the translated current amplitudes that would bring them closest to
        the data's, see `amplitude_shift`.
    gains
        What held-out pulses say of each part that was tried.
    """

    checks: Verdict
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
    gains: dict[str, str] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """Remaining difference between translation and data, in a sentence."""
        shift, error = 100 * self.amplitude_shift, 100 * self.amplitude_shift_error
        off = abs(shift) >= 2 * error
        right = f"right to {abs(shift) + error:.2f} %"
        size = f"off by {shift:+.2f} ± {error:.2f} %" if off else right
        # a shift that is small compared with its error does not make the shape right
        more = f"; the current amplitude is {size}" if off or self.checks.good else ""
        return f"{self.checks}{more}"


def fit_response(
    sets: PulseSets, fitter: Fitter, known: ElectronicsResponse | None = None
) -> tuple[ElectronicsResponse, Fit]:
    """Fit a response to unpaired prepared pulses.

    Parameters
    ----------
    sets
        Pulses of both sides.  Single sites of the continuum are compared, too, if the drift was
        stretched.
    fitter
        Settings of the fits; counts their steps.
    known
        Response of a similar readout, with the recipe's configuration, to start from.  The
        recipe's own starts are tried only if that fails.

    Raises
    ------
    CpunetError
        If there are too few pulses, or the fit does not find a finite chi-square.
    """
    config, _ = sets.recipe.matching
    some = sets.bands(fitter.training.search_pulses)
    first = ResponseProblem(ElectronicsResponse(config, sets.noise.dt_ns), some, draws=1)
    everything = sets.bands()
    found = None if known is None else from_known(first, known, fitter)
    tried = []
    for factor in fitter.training.start_factors:
        found = found or from_start(first, config, fitter, factor)
        tried.append((_learned(found, everything, sets, fitter), found))
        if tried[-1][0].checks.good or not found.poor:
            break  # there is no other valley to search for
        found = None
    best, found = min(tried, key=lambda one: one[0].checks.chi_square)
    if best.checks.good or not onset_is_off(found.problem):
        return best.described(everything, fitter)
    stretched = _stretched(found.problem.of(best.chain, sets.bands(CHECKED)), fitter)
    if stretched is not None:
        further = _single_sites(stretched.problem.response, sets, fitter)
        everything = [*everything, *further]
        other = _learned(stretched, everything, sets, fitter)
        if other.checks.chi_square < best.checks.chi_square:
            best, found = other, stretched
    if best.checks.chi_square < HOPELESS:
        return best.described(everything, fitter)
    return _with_wrong_physics(best, found, everything, sets, fitter)


class _Learned(NamedTuple):
    """A chain, the response with its deviations, if any, and what every sample says of it."""

    chain: ElectronicsResponse
    response: ElectronicsResponse
    checks: Verdict
    covariance: Values | None

    def described(
        self, bands: Sequence[Band], fitter: Fitter
    ) -> tuple[ElectronicsResponse, Fit]:
        """The response and its fit."""
        problem = ResponseProblem(self.response, bands)
        return self.response, described(problem, self.covariance, self.checks, fitter)


def _learned(found: Fitted, bands: Sequence[Band], sets: PulseSets, fitter: Fitter) -> _Learned:
    """Determine a chain from all pulses, and learn what it does not do."""
    chain, covariance = copy.deepcopy(found.problem.response), None
    if chain.drift is not None:
        # optimal weights trust the shapes of the pulses to a thousandth, and a simulation whose
        # drift had to be stretched is not as good as that
        whole = fitter.fit(ResponseProblem(chain, bands), coarse=False)
        covariance = whole.covariance
    elif not found.poor:
        compared, near = ResponseProblem(chain, bands), found.problem.of(chain)
        for _ in range(ROUNDS):
            covariance = refine(near, bands, fitter.training.conditional_bins)
            deviations = compared.deviations(compared.parameters.vector())
            fitter.count(float(deviations @ deviations))
    sides = sets.sides(chain)
    if not found.poor:
        checks = verdict(chain, sides)
        # single sites of the continuum are not in the comparison at every sample
        if checks.good if chain.drift is not None else checks.clear:
            return _Learned(chain, chain, checks, covariance)
    response = with_deviations(chain, sides, fitter.count).response
    return _Learned(chain, response, verdict(response, sides), covariance)


def _single_sites(response: ElectronicsResponse, sets: PulseSets, fitter: Fitter) -> list[Band]:
    """Single sites of the continuum, if held-out pulses of line and continuum gain by them.

    If the simulated drift is wrong, so are the charge clouds.  Nearly all pulses of a line have
    many sites, whose clouds are not as large as that of one; the sharp peak of these tells.
    They are more data and no more freedom, so any gain is enough.
    """
    if not (single := sets.single_sites()):
        return []
    line = sets.bands(CHECKED)
    gain = held_out_gain([(response, len(line)), (response, None)], [*line, *single], fitter)
    better = gain.mismatch[1] < gain.mismatch[0]
    fitter.gains[SINGLE] = f"{'used' if better else 'left out'}; {gain}"
    return single if better else []


def _stretched(problem: ResponseProblem, fitter: Fitter) -> Fitted | None:
    """Stretch the drift, and let the stretch change with time, as far as that gains."""
    found = fitter.fit(problem, coarse=False)
    for _ in range(fitter.training.drift_terms):
        found = drift_if_better(found, fitter)
    return None if found.problem.response.drift is None else drift_if_needed(found, fitter)


def _with_wrong_physics(
    best: _Learned, found: Fitted, bands: Sequence[Band], sets: PulseSets, fitter: Fitter
) -> tuple[ElectronicsResponse, Fit]:
    """A chain fitted with model errors of the simulation, which no response makes agree.

    The shape of the edge would distort it; see `ResponseProblem.allow_for_model_error`.
    """
    problem = found.problem.of(best.chain)
    problem.allow_for_model_error()
    covariance = fitter.fit(problem, coarse=False).covariance
    checks = verdict(best.chain, sets.sides(best.chain))
    return _Learned(best.chain, best.chain, checks, covariance).described(bands, fitter)


def described(
    problem: ResponseProblem, covariance: Values | None, checks: Verdict, fitter: Fitter
) -> Fit:
    """Describe the fit of a response; the covariance is that of the moments if not given."""
    parameters = problem.parameters
    vector = parameters.vector()
    if covariance is None:
        slopes = problem.derivatives(vector)
        covariance = parameters.covariance(slopes.T @ slopes)
    pulls, deviations = problem.pulls(vector), problem.deviations(vector)
    whole = [band for band in problem.bands if band.moments.balance is None]
    shift, shift_error = amplitude_shift(problem.response, whole)
    fitter.count(float(deviations @ deviations))
    return Fit(
        checks=checks,
        chi_square=float(deviations @ deviations),
        moments=problem.moments,
        pairs=sum(band.pairs for band in problem.bands),
        steps=fitter.steps,
        gains=fitter.gains,
        errors=parameters.by_name(np.sqrt(covariance.diagonal())),
        pulls=dict(zip(problem.names, pulls.tolist(), strict=True)),
        data_left_out=sum(band.moments.left_out for band in problem.bands),
        covariance=covariance.tolist(),
        bands={b.name: [len(b.sim), len(b.moments.data)] for b in problem.bands},
        amplitude_shift=shift,
        amplitude_shift_error=shift_error,
    )


BINS = 32  # of the logarithm of the amplitude
STEP = 0.002  # of the logarithm of the amplitude, for the derivative
NEAR = 0.02  # maximum shift in which densities are linear without doubt


class _Shift(NamedTuple):
    """Shift by a linear fit, the chi-square where it starts, and the shift of the mean."""

    chi_square: float
    shift: float
    error: float
    of_mean: float


def amplitude_shift(
    response: ElectronicsResponse, bands: Sequence[Band]
) -> tuple[float, float]:
    """Relative shift that the translated current amplitudes need, and its error.

    It is a least-squares fit to the densities of its logarithm, with their covariance from the
    data's events.  If the mean logarithms differ much, the fit starts from their difference,
    unless the densities agree better without it.

    Parameters
    ----------
    response
        Response that translates the simulated pulses.
    bands
        Bands to compare.
    """
    found = _linear_fit(response, bands, 0.0)
    if abs(found.of_mean) > NEAR:
        found = min(found, _linear_fit(response, bands, found.of_mean))
    return found.shift, found.error


def _linear_fit(response: ElectronicsResponse, bands: Sequence[Band], start: float) -> _Shift:
    """Fit from amplitudes that are already shifted by `start`."""
    chi_square = weight = weighted = weight_of_mean = weighted_mean = 0.0
    for band in bands:
        functions = ConditionalFunctions.of(band.moments, BINS)
        density, slope, mean = _density(band, functions, response, start)
        logs = band.moments.data.log_amplitude
        values = functions.density(logs)
        apart = values.mean(axis=0) - density
        inverse = np.linalg.inv(np.cov(values.T) / band.pairs + 1e-12 * np.eye(len(slope)))
        chi_square += float(apart @ inverse @ apart)
        weight += float(slope @ inverse @ slope)
        weighted += float(slope @ inverse @ apart)
        weight_of_mean += band.pairs
        weighted_mean += band.pairs * float(logs.mean() - mean)
    weight = max(weight, 1.0)  # an error of more than 100 % is that of no overlap
    shift = start + weighted / weight
    return _Shift(chi_square, shift, weight**-0.5, weighted_mean / weight_of_mean)


def _density(
    band: Band, functions: ConditionalFunctions, response: ElectronicsResponse, start: float
) -> tuple[Values, Values, Values]:
    """Mean densities of translated amplitudes, derivatives in the shift, and mean logarithm."""

    def of(readings: Readings) -> tuple[Values, ...]:
        logs, weights = readings.log_amplitude, readings.weights
        shifts = (start, start + STEP, start - STEP)
        return (*(weights @ functions.density(logs + s) for s in shifts), weights @ logs)

    (here, up, down, total), n = band.sim.sums(response, of)
    return here / n, (up - down) / (2 * STEP * n), total / n
