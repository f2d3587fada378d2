"""What a search ended with, and the physics that it gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cpunet.calibration.calibrated_run import (
    CalibratedPhysics,
    ChiSquare,
    Direction,
    FixedParameter,
    FreeParameter,
)
from cpunet.calibration.identifiability import Information, together
from cpunet.calibration.joint_problem import JointProblem
from cpunet.calibration.nuisances import Physics, Values
from cpunet.networks.response_layer import ElectronicsResponse

# Number of prior errors beyond which a parameter is reported as unexpected.
FAR = 3.0
# Chi-square beyond chance, in its standard deviations, that is too much.
BEYOND_CHANCE = 4.0
# Advice where a parameter is unexpected, besides the general advice.
ADVICE = {
    "self_repulsion": "it acts within each hit, so hits that are not merged within "
    "0.2 mm (cluster_mm), as tracks are long, need more of it"
}
# Minimum decrease of chi-square that is reported for a further parameter.
NOTABLE = 9.0


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Chain and physics that explain the data.

    Parameters
    ----------
    problem
        Comparison at the end of the search: chain, coordinates, functions, pulses.
    covariance
        Covariance of its parameters, with errors of the functions larger by `scale`.
    chi_square_before, pulls_before
        Chi-square and pulls with the chain alone, for the physics as simulated.
    chi_square
        Chi-square with chain and physics.
    scale
        Factor of the errors from imperfect agreement, see `JointProblem.by_chance`.
    information
        Information on all physics.
    promised
        Expected decrease of chi-square for each fixed parameter if it were free, by position.
    rounds, settled
        Number of rounds, and whether the physics was unchanged in the last.
    alternatives
        Other physics that explain the data about as well, and by how much chi-square with
        priors is larger.
    """

    problem: JointProblem
    covariance: Values
    chi_square_before: float
    pulls_before: Values
    chi_square: float
    scale: float
    information: Information
    promised: dict[int, float]
    rounds: int
    settled: bool
    alternatives: Sequence[tuple[JointProblem, float]] = ()

    @property
    def response(self) -> ElectronicsResponse:
        """The chain."""
        chain: ElectronicsResponse = self.problem.parameters.chain.response
        return chain

    @property
    def physics(self) -> Physics:
        """Physics that the coordinates refer to."""
        return self.problem.nearby.simulator.physics


def described(calibrated: Calibrated) -> CalibratedPhysics:
    """The calibrated physics in the units of their parameters."""
    problem = calibrated.problem
    mean, spread = problem.by_chance
    free, n = _free(calibrated), problem.parameters.n_chain
    return CalibratedPhysics(
        parameters=free,
        fixed=_fixed(calibrated),
        together=_together(calibrated),
        others=_others(calibrated),
        directions=calibrated.information.directions(),
        chi_square=ChiSquare(
            before=calibrated.chi_square_before,
            after=calibrated.chi_square,
            moments=problem.moments,
            expected=mean,
            spread=spread,
            errors_scaled_by=calibrated.scale,
        ),
        covariance=calibrated.covariance[n:, n:].tolist(),
        functions=list(problem.names),
        pulls_before=calibrated.pulls_before.tolist(),
        pulls_after=problem.pulls().tolist(),
        rounds=calibrated.rounds,
        settled=calibrated.settled,
        notes=_notes(calibrated, free),
    )


def _notes(calibrated: Calibrated, free: Mapping[str, FreeParameter]) -> list[str]:
    """Remarks on the result of a calibration."""
    problem = calibrated.problem
    remarks = [
        f"the fit uses {name} = {parameter.value:.4g} to make up for something else "
        f"({parameter.doubt}): free what else moves pulses so, or give a `prior` if it can be"
        + (f"; {ADVICE[name]}" if name in ADVICE else "")
        for name, parameter in free.items()
        if parameter.doubt
    ]
    per = calibrated.chi_square / problem.moments
    mean, spread = (number / problem.moments for number in problem.by_chance)
    if per <= mean + BEYOND_CHANCE * spread:
        rest = "" if remarks else ": no other physics are needed"
        text = f"expected from statistics ({mean:.2f} ± {spread:.2f}){rest}"
        return [*remarks, f"chi-square is {per:.2f} per function, {text}"]
    fall, best = max(((fall, i) for i, fall in calibrated.promised.items()), default=(0.0, 0))
    rest = "none of the parameters looked at explains it"
    if fall > NOTABLE:
        name = calibrated.physics.nuisances[best].name
        rest = f"with {name} free, too, it would fall by {fall:.0f}"
    text = f"a poor fit (expected from statistics: {mean:.2f} ± {spread:.2f}); {rest}"
    return [*remarks, f"chi-square is {per:.2f} per function, {text}"]


def _free(calibrated: Calibrated) -> dict[str, FreeParameter]:
    """Value and errors of each free parameter, by name."""
    parameters, physics = calibrated.problem.parameters, calibrated.physics
    centres, widths = physics.priors(parameters.given)
    errors = np.sqrt(calibrated.covariance.diagonal()[parameters.n_chain :])
    information = calibrated.information
    # sampling noise makes those with all free larger, too
    errors_all = information.errors()
    larger = errors / information.errors(parameters.free)
    free = {}
    for k, (i, error) in enumerate(zip(parameters.free, errors, strict=True)):
        name, x = physics.nuisances[i].name, float(parameters.coordinates[i])
        value, own_error = physics.in_own_unit(i, x, error)
        centre, width = physics.in_own_unit(i, float(centres[i]), widths[i])
        free[name] = FreeParameter(
            value=value,
            error=own_error,
            error_all=physics.in_own_unit(i, x, larger[k] * errors_all[i])[1],
            simulated=physics.nominal(physics.nuisances[i]),
            doubt=_doubt(calibrated, k, value),
            prior=centre,
            prior_error=width,
            source="given" if name in parameters.given else physics.nuisances[i].source,
        )
    return free


def _fixed(calibrated: Calibrated) -> dict[str, FixedParameter]:
    """Each fixed parameter by name; fall of chi-square, and its error, if it were free."""
    parameters, physics = calibrated.problem.parameters, calibrated.physics
    fixed = {}
    for i, fall in calibrated.promised.items():
        error = calibrated.scale * calibrated.information.errors([*parameters.free, i])[-1]
        value, own_error = physics.in_own_unit(i, float(parameters.coordinates[i]), error)
        fixed[physics.nuisances[i].name] = FixedParameter(
            value=value, chi_square_would_fall_by=fall, error_if_free=own_error
        )
    return fixed


def _doubt(calibrated: Calibrated, k: int, value: float) -> str | None:
    """Why the value of the free parameter number `k` is unreliable."""
    parameters = calibrated.problem.parameters
    low, high = calibrated.physics.nuisances[parameters.free[k]].possible
    k += parameters.n_chain
    x = parameters.vector()[k]
    off = abs(x - parameters.centre[k]) / parameters.widths[k]
    if x in (parameters.low[k], parameters.high[k]) and value != 0:  # none of it can be true
        return "at its bound"
    if not low <= value <= high:
        return f"{low:g} to {high:g} is possible"
    return f"{off:.1f} errors of its prior from it" if off > FAR else None


def _together(calibrated: Calibrated) -> list[Direction]:
    """Pairs of free parameters of which only a combination is determined."""
    parameters, n = calibrated.problem.parameters, calibrated.problem.parameters.n_chain
    widths = parameters.widths[n:]
    off = (parameters.vector()[n:] - parameters.centre[n:]) / widths
    at = dict(zip(parameters.names, off.tolist(), strict=True))
    scaled = calibrated.covariance[n:, n:] / np.outer(widths, widths)
    pairs = together(parameters.names, scaled)
    values = [sum(size * at[n] for n, size in pair.components.items()) for pair in pairs]
    return [
        pair.model_copy(update={"value": value})
        for pair, value in zip(pairs, values, strict=True)
    ]


def _others(calibrated: Calibrated) -> list[str]:
    """Other physics that explain the pulses as well: free values, and rise of chi-square."""
    lines = []
    for problem, rise in calibrated.alternatives:
        values = calibrated.physics.values(problem.parameters.coordinates)
        sizes = ", ".join(f"{name} {values[name]:.4g}" for name in problem.parameters.names)
        lines.append(f"{sizes} (chi-square {rise:+.1f})")
    return lines
