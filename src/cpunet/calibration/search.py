"""Search for the chain and the physics that together explain the data.

It starts from a chain fitted to the simulation as it is. In each round, pulses are simulated
for the current physics, and chain and physics are fitted to the data with pulses near it. The
search ends when the physics no longer changes.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from cpunet.calibration.calibrated_run import CalibratedPhysics, ChiSquare
from cpunet.calibration.identifiability import Linear
from cpunet.calibration.joint_problem import JointProblem, SlicedJoint, events, first
from cpunet.calibration.nearby import Nearby, Simulator
from cpunet.calibration.nuisances import Values, depletion
from cpunet.calibration.result import BEYOND_CHANCE, described, of_parts, of_weights
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.chain_fit import (
    POOR,
    WIDER,
    Fitter,
    Parabola,
    fit_chain,
    with_decay,
    with_settings,
)
from cpunet.training.deviations import with_deviations
from cpunet.training.pulse_sets import PulseSets

log = logging.getLogger(__name__)

ROUNDS = 8
# The search ends when all coordinates move by less than this fraction of their error.
SETTLED = 0.4
# Maximum move of a coordinate in a round, in units of the reach of its derivative, and number
# of times the move is halved if pulses cannot be simulated after it.
FARTHEST, HALVINGS = 1.5, 4
# Decrease of chi-square of held-out pulses (five standard deviations) for which a fixed
# parameter is freed, and of all pulses, for which another takes the place of a free one; and
# maximum number of such changes.
NEEDED, MAX_MORE = 25.0, 3
# Other sets of parameters explain the pulses about as well if chi-square rises by less than
# this in a linear fit; so many are named.
SAME, MAX_OTHERS = 9.0, 2
USUAL_ROUNDS = 4  # of most searches, for the remaining time
# Number of events used to examine fixed parameters.
LOOKED_AT_WITH = 1024


@dataclass(eq=False)
class Search:
    """A search in rounds.

    Parameters
    ----------
    simulator
        Simulation of the events, with all parameters that may become free.
    sets
        Prepared simulated and measured datasets, in bands.
    chosen
        Whether all parameters are free, since a user chose them; else those that the data
        determine.
    """

    simulator: Simulator
    sets: PulseSets
    chosen: bool = False

    def __post_init__(self) -> None:
        self._sides = self.sets.sides()
        physics, recipe = self.simulator.physics, self.sets.recipe
        n, knowledge = len(physics.nuisances), depletion(physics)
        self._all, self._simulated = list(range(n)), np.zeros(n)
        self._first = [i for i in self._all if self.chosen or physics.nuisances[i].first]
        config, training = recipe.matching
        start = ElectronicsResponse(config, physics.settings.dt_ns)
        start = with_decay(start, self.sets.tail_slope)
        # the chain alone, with the physics as simulated
        few = [sides.of(training.search_pulses) for sides in self._sides]
        self._chain = fit_chain(copy.deepcopy(start), few, Fitter(training)).response
        self._sides = [sides.cut_like_data(self._chain) for sides in self._sides]
        self._functions = self._compared(1.0)
        # of a chain, pulses near a point, free coordinates, and functions
        self._problem = partial(JointProblem, recipe=recipe, start=start, knowledge=knowledge)
        # of a usual search: derivatives take two each, of the first parameters, and of all
        self.simulations = USUAL_ROUNDS + 3 + 2 * (len(self._first) + len(self._all))

    def plan(self) -> Linear:
        """What the pulses say of all parameters that may become free, before a fit."""
        few, at = first(self._functions), self._simulated
        nearby = Nearby(self.simulator, at, self.simulator(at)).again(self._all, events(few))
        return self._looked(self._problem(self._chain, nearby, self._all, few))

    def run(self) -> tuple[JointProblem, CalibratedPhysics]:
        """Search until the physics no longer changes: the last comparison, and its result.

        Raises
        ------
        CpunetError
            If pulses cannot be simulated for the detector as given.
        """
        at, response = self._simulated, self._chain
        nearby = Nearby(self.simulator, at, self.simulator(at)).again(self._first)
        before = self._problem(response, nearby, [], self._functions, held=True)
        chi_square, _ = before.compared()
        self._tell("as simulated", before, chi_square)
        problem, end = self._from_far(response, nearby)
        if end.chi_square > POOR * problem.moments:  # as if the readout rings
            self._tell("without deviations", problem, end.chi_square)
            response = self._deviated(before, chi_square) or response
            problem, end = self._from_far(response, nearby)
        free, more, last = list(problem.free), 0, at
        for number in range(1, ROUNDS + 1):
            if number > 1:
                problem = self._problem(response, nearby, free, self._functions)
                end = problem.fitted()
            self._tell(f"round {number}", problem, end.chi_square)
            response = problem.response
            moves = problem.coordinates - nearby.centre
            settled = (
                number > 1
                and bool((np.abs(moves[free]) < SETTLED * problem.errors).all())
                and not np.delete(nearby.centre, free).any()
            )
            if settled and not response.config.deviations:
                other = self._deviated(problem, end.chi_square)
                response, settled = other or response, settled and other is None
            examined = self._examined(problem) if settled or number == ROUNDS else None
            better = None
            if examined is not None and more < MAX_MORE and not self.chosen:
                better = self._better(examined, free)
            if number == ROUNDS or (settled and better is None):
                break
            if better is not None:
                free, more = better, more + 1
            # all that is not free is as simulated
            aim = np.where(np.isin(self._all, free), problem.coordinates, 0.0)
            last = _relaxed(aim - nearby.centre, last)
            nearby = self._moved(nearby, last, free)
        assert examined is not None
        return self._ended(problem, before, examined, rounds=number, settled=settled)

    def _from_far(
        self, response: ElectronicsResponse, nearby: Nearby
    ) -> tuple[JointProblem, Parabola]:
        """First fit, to some of the pulses, with wider functions first.

        Free are all parameters, if chosen, or those of the first that the pulses determine.
        """
        free, at = self._all, nearby.centre
        if not self.chosen:
            problem = self._problem(response, nearby, self._first, first(self._functions))
            free = [self._first[i] for i in self._looked(problem).begin()]
        for wider in (*WIDER, 1.0):
            functions = first(self._compared(wider))
            problem = self._problem(
                response, nearby, free, functions, held=True, coordinates=at
            )
            end = problem.fitted()
            response, at = problem.response, problem.coordinates
        return problem, end

    def _compared(self, wider: float) -> list[SlicedJoint]:
        """Functions of each band, with bins wider by a factor."""
        several = len(self._sides) > 1
        return [
            SlicedJoint(sides, wider, sides.name if several else "") for sides in self._sides
        ]

    def _deviated(self, problem: JointProblem, chi_square: float) -> ElectronicsResponse | None:
        """The chain with deviations of its step response, if these physics leave too much.

        Physics would absorb a part of it: an early decay between the fixed ones looks like more
        self-repulsion, and so does a ringing.
        """
        mean, spread = problem.by_chance
        if chi_square < mean + BEYOND_CHANCE * spread:
            return None
        chain = with_settings(problem.response, deviations=False)
        sides = [functions.sides for functions in problem.here()]
        response, modes = with_deviations(chain, sides, lambda _: None)
        if not response.config.deviations:
            return None
        self._problem = partial(self._problem, modes=modes)
        return response

    def _moved(self, nearby: Nearby, moved: Values, free: Sequence[int]) -> Nearby:
        """Pulses at the moved coordinates, with moves limited to `FARTHEST` times the reach."""
        nuisances = self.simulator.physics.nuisances
        farthest = FARTHEST * np.array([nuisance.reach for nuisance in nuisances])
        move = np.clip(moved, -farthest, farthest)
        for _ in range(HALVINGS):
            try:
                at = nearby.centre + move
                place = replace(nearby, centre=at, base=self.simulator(at))
                break
            except CpunetError as error:  # for example, if the detector is not depleted
                log.info(f"{error}; going half as far")
                move = 0.5 * move
        else:
            raise CpunetError(
                f"detector {self.simulator.physics.detector.name}: the data ask for physics "
                "that cannot be simulated; narrow a `prior`, or leave a parameter out of `free`"
            )
        reach = farthest / FARTHEST
        return place.again(place.outdated(free, reach, len(place.base)))

    def _better(self, linear: Linear, free: Sequence[int]) -> list[int] | None:
        """Parameters that explain the pulses better if they are free, if any do significantly.

        These are the free with another that held-out pulses need most, or in exchange.
        """
        here = linear.score(free)
        more = [sorted([*free, i]) for i in self._all if i not in free]
        falls = [here - linear.score(other) for other in more]
        if falls and max(falls) > NEEDED:
            return more[int(np.argmax(falls))]
        others = [(linear.cost(other)[0], other) for other in linear.others(free)]
        cost, other = min(others, default=(np.inf, []))
        return other if cost < linear.cost(free)[0] - NEEDED else None

    def _examined(self, problem: JointProblem) -> Linear:
        """What some of the pulses say of all parameters, also of those that are fixed."""
        fixed = [i for i in self._all if i not in problem.free]
        few = first(self._functions, LOOKED_AT_WITH)
        problem.nearby = problem.nearby.again(problem.nearby.outdated(fixed), events(few))
        every = self._problem(
            problem.response, problem.nearby, self._all, few, coordinates=problem.coordinates
        )
        return self._looked(every)

    def _looked(self, problem: JointProblem) -> Linear:
        """What all pulses, and each half of them, tell of the free parameters."""
        vector = problem.vector()
        residuals, jacobian, _ = problem.both(vector)
        half, halves = copy.copy(problem), []
        for k in range(2):
            half.functions = [of.some(slice(k, None, 2)) for of in problem.functions]
            halves.append(half.residuals(vector))
        return Linear(
            jacobian,
            residuals,
            np.array(halves)[:, : problem.moments],
            problem.coordinates[problem.free],
            problem.widths,
            # half of the harmonic mean of both sides
            sum(1 / (1 / len(of.sides) + 1 / len(of.sides.data)) for of in problem.functions),
        )

    def _ended(
        self, problem: JointProblem, before: JointProblem, linear: Linear, **facts: Any
    ) -> tuple[JointProblem, CalibratedPhysics]:
        """The result, without the sampling noise of the simulated events."""
        mean, spread = problem.by_chance
        # errors grow by the root of chi-square over its upper limit by chance (two sigmas)
        scale = float(np.sqrt(max(1.0, problem.compared()[0] / (mean + 2 * spread))))
        vector = problem.vector()
        _, jacobian, parts = problem.both(vector)
        n = sum(len(of.sides) + len(of.sides.data) for of in problem.functions)
        factor = scale**2 * of_weights(n, mean, len(vector))
        move, covariance = of_parts(jacobian, *parts, factor)
        problem.set(np.clip(problem.vector() + move, problem.low, problem.high))
        chi_before, pulls_before = replace(before, weights=problem.weights).compared()
        chi_after, pulls_after = problem.compared()
        chi = ChiSquare(
            before=chi_before,
            after=chi_after,
            moments=problem.moments,
            expected=mean,
            spread=spread,
            errors_scaled_by=scale,
        )
        free = problem.free
        others = [] if self.chosen else [*linear.others(free)]
        lines = []
        for other in sorted(others, key=lambda other: linear.cost(other)[0])[:MAX_OTHERS]:
            cost, place = linear.cost(other)
            if (rise := cost - linear.cost(free)[0]) < SAME:
                values = self.simulator.physics.values(place).items()
                sizes = [f"{n} {v:.4g}" for i, (n, v) in enumerate(values) if i in other]
                lines.append(f"{', '.join(sizes)} (chi-square {rise:+.1f})")
        facts |= {"others": lines, "pulls_before": pulls_before.tolist()}
        facts["pulls_after"] = pulls_after.tolist()
        return problem, described(problem, covariance, chi, linear, **facts)

    def _tell(self, when: str, problem: JointProblem, chi_square: float) -> None:
        physics = self.simulator.physics
        words = [f"{when}: chi-square {chi_square / problem.moments:.2f} per function"]
        for i, error in zip(problem.free, problem.errors, strict=True):
            value, own = physics.in_own_unit(i, float(problem.coordinates[i]), error)
            words.append(f"{physics.nuisances[i].name} {value:.4g} ± {own:.2g}")
        log.info(", ".join(words))


def _relaxed(moved: Values, last: Values) -> Values:
    """Damp moves that change sign, by linear interpolation with the previous moves.

    Where pulses are far from linear, a search oscillates around its solution.
    """
    back = moved * last < 0
    share = np.ones(len(moved))
    share[back] = 1 / (1 + np.abs(moved[back] / last[back]))
    return share * moved
