"""Fit a readout chain to unpaired pulses: least squares on moments, with errors.

The parameters of a response are those for which the moments of the translated simulation,
including noise, agree best with those of the data: a chi-square fit of about ten parameters by
the Levenberg–Marquardt method, with exact derivatives at fixed random numbers.
Some of the pulses are enough to find the valley of chi-square; all of them, optimally weighted,
then determine the response within it.

With enough pulses any chain differs significantly from the true one: chi-square grows with
their number.  What matters is the effect of the difference on the current amplitude, which
users cut on.  It is therefore also given as the shift of the current amplitude (A of A/E) that
would best match the translated distribution to the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse, Readout
from cpunet.training.fitter import GOOD_FIT, Fitted, Fitter, held_out_gain
from cpunet.training.moments import Readings, Values
from cpunet.training.optimal_weights import ConditionalFunctions, refine
from cpunet.training.pulse_sets import SINGLE, PulseSets
from cpunet.training.response_problem import Band, ResponseProblem
from cpunet.training.response_starts import (
    HOPELESS_FIT,
    best_start,
    drift_if_better,
    drift_if_needed,
    free_decay_if_better,
    from_known,
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
        per, why = self.chi_square / self.moments, "as by chance"
        if self.poor:
            why = "too much for chance"
        elif per > GOOD_FIT:
            why = "of a misfit that only so many pulses tell"
        # a shift that is small compared with its error does not make the shape right
        more = f"; the current amplitude is {size}" if off or not self.poor else ""
        return f"chi-square is {per:.1f} per moment, {why}{more}"

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
    config = sets.recipe.chain
    some = sets.bands(fitter.training.search_pulses)
    first = ResponseProblem(ElectronicsResponse(config, sets.noise.dt_ns), some, draws=1)
    near = None if known is None else from_known(first, known, fitter)
    found = near or best_start(first, config, fitter)
    everything = sets.bands()
    response = found.problem.response
    if response.drift is None and not found.poor:
        fit = _determined(found, everything, sets, fitter)
        if not fit.poor:
            return response, fit
    elif found.per_moment > ANOTHER_DETECTOR and onset_is_off(found.problem):
        return response, _with_wrong_physics(found, fitter)
    more = found.problem.of(response, sets.bands(CHECKED))
    found = _extended(fitter.fit(more, coarse=False), fitter)
    response = found.problem.response
    if found.poor and onset_is_off(found.problem):
        return response, _with_wrong_physics(found, fitter)
    return response, _determined(found, everything, sets, fitter)


def _extended(found: Fitted, fitter: Fitter) -> Fitted:
    """Extend the response by what brings a poor or stretched fit closer."""
    stretched = found.problem.response.drift is not None
    hopeless = found.per_moment > HOPELESS_FIT
    if hopeless:  # nothing else may stand in for a ringing
        found = ringing_if_better(found, fitter)
    elif stretched:
        found = drift_if_better(found, fitter)
    # a stretch hides some of what another decay does
    if found.poor or (stretched and found.per_moment > HIDDEN):
        found = free_decay_if_better(found, fitter)
    if found.poor and not hopeless:
        found = ringing_if_better(found, fitter)
    if stretched or (found.poor and onset_is_off(found.problem)):
        found = drift_if_better(found, fitter)
        found = drift_if_needed(found, fitter)
    return found


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


def _determined(found: Fitted, bands: Sequence[Band], sets: PulseSets, fitter: Fitter) -> Fit:
    """Determine the response within its valley from all pulses.

    Optimal weights trust the shapes of the pulses to a thousandth.  A simulation whose drift
    had to be stretched is not as good as that, so the moments alone are compared there.
    """
    response = found.problem.response
    if response.drift is not None:
        further = _single_sites(response, sets, fitter)
        whole = fitter.fit(ResponseProblem(response, [*bands, *further]), coarse=False)
        return described(whole.problem, whole.covariance, fitter)
    compared = ResponseProblem(response, bands)
    for _ in range(ROUNDS):
        covariance = refine(found.problem, bands, fitter.training.conditional_bins)
        deviations = compared.deviations(compared.parameters.vector())
        fitter.count(float(deviations @ deviations))
    return described(compared, covariance, fitter)


def _with_wrong_physics(found: Fitted, fitter: Fitter) -> Fit:
    """Fit with model errors of the simulation, but report the chi-square without them."""
    problem = found.problem
    deviations = problem.deviations(problem.parameters.vector())
    problem.allow_for_model_error()
    again = fitter.fit(problem, coarse=False)
    fit = described(problem, again.covariance, fitter)
    return replace(fit, chi_square=float(deviations @ deviations))


def described(problem: ResponseProblem, covariance: Values, fitter: Fitter) -> Fit:
    """Describe the fit of a response."""
    parameters = problem.parameters
    vector = parameters.vector()
    pulls, deviations = problem.pulls(vector), problem.deviations(vector)
    whole = [band for band in problem.bands if band.moments.balance is None]
    shift, shift_error = amplitude_shift(problem.response, whole)
    return Fit(
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


def amplitude_shift(response: Readout, bands: Sequence[Band]) -> tuple[float, float]:
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


def _linear_fit(response: Readout, bands: Sequence[Band], start: float) -> _Shift:
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
    band: Band, functions: ConditionalFunctions, response: Readout, start: float
) -> tuple[Values, Values, Values]:
    """Mean densities of translated amplitudes, derivatives in the shift, and mean logarithm."""

    def of(readings: Readings) -> tuple[Values, ...]:
        logs, weights = readings.log_amplitude, readings.weights
        shifts = (start, start + STEP, start - STEP)
        return (*(weights @ functions.density(logs + s) for s in shifts), weights @ logs)

    (here, up, down, total), n = band.sim.sums(response, of)
    return here / n, (up - down) / (2 * STEP * n), total / n
