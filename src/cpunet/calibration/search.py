"""Search for the chain and the physics that together explain the data.

It starts from a chain fitted to the simulation as it is. In each round, pulses are simulated
for the current physics, and chain and physics are fitted to the data with pulses near it. The
search ends when the physics no longer changes.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cpunet.calibration.identifiability import Information, Selection
from cpunet.calibration.joint_problem import JointParameters, JointProblem, events, first
from cpunet.calibration.nearby import Nearby, Simulator
from cpunet.calibration.nuisances import Values
from cpunet.calibration.result import BEYOND_CHANCE, Calibrated
from cpunet.calibration.sampling import of_events
from cpunet.calibration.sliced_functions import SlicedJoint
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.schema import Recipe
from cpunet.training.chain_fit import POOR, WIDER, Fitter, Parabola, fit_chain
from cpunet.training.chain_parameters import with_decay, with_settings
from cpunet.training.comparison import NONE
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
# parameter is freed, and maximum number of such parameters.
NEEDED, MAX_MORE = 25.0, 3
# Other sets of parameters are fitted if chi-square would rise by less than this in a linear
# forecast, and are alternatives if it does so by less than the second; most, and their rounds.
LIKELY, SAME, MAX_OTHERS, OTHER_ROUNDS = 16.0, 9.0, 2, 2
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
    recipe
        Recipe of the chain.
    given
        Priors that replace the defaults: value and error by name.
    knowledge
        Deviations from further knowledge of the coordinates.
    chosen
        Whether all parameters are free, since a user chose them; else those that the data
        determine.
    """

    simulator: Simulator
    sets: PulseSets
    recipe: Recipe
    given: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    knowledge: Callable[[Values], Values] = lambda _: np.empty(0)
    chosen: bool = False

    def __post_init__(self) -> None:
        self._sides = self.sets.sides()
        several = len(self._sides) > 1
        self._bands = [name if several else "" for name in self.sets.names]
        self._functions = self._wide(1.0)
        nuisances = self.simulator.physics.nuisances
        self._all = list(range(len(nuisances)))
        self._first = [i for i in self._all if self.chosen or nuisances[i].first]
        dt_ns = self.simulator.physics.settings.dt_ns
        self._start = ElectronicsResponse(self.recipe.matching.generator, dt_ns)
        with_decay(self._start, self.sets.tail_slope)
        self._modes = NONE

    def plan(self) -> Information:
        """Information of the pulses on all parameters that may become free, before a fit."""
        few = first(self._functions)
        nearby = Nearby.about(self.simulator, np.zeros(self._n), [])
        nearby = nearby.again(self._all, events(few))
        return self._looked(self._problem(self._chain(), nearby, self._all, few))[0]

    def run(self) -> Calibrated:
        """Search until the physics no longer changes.

        Raises
        ------
        CpunetError
            If pulses cannot be simulated for the detector as given.
        """
        nearby = Nearby.about(self.simulator, np.zeros(self._n), self._first)
        response = self._chain()
        before = self._problem(response, nearby, [], held=True)
        self._tell("as simulated", before)
        free = self._first_free(response, nearby)
        problem, end = self._from_far(response, nearby, free)
        if problem.chi_square() > POOR * problem.moments:  # as if the readout rings
            self._tell("without deviations", problem, end)
            response = self._deviated(before) or response
            free = self._first_free(response, nearby)
            problem, end = self._from_far(response, nearby, free)
        more, last = 0, np.zeros(self._n)
        for number in range(1, ROUNDS + 1):
            if number > 1:
                problem = self._problem(response, nearby, free)
                end = problem.fitted()
            self._tell(f"round {number}", problem, end)
            response = problem.parameters.chain.response
            moved = problem.parameters.coordinates - nearby.centre
            settled = number > 1 and _settled(problem, end, moved)
            if settled and not response.config.deviations:
                other = self._deviated(problem)
                response, settled = other or response, settled and other is None
            added = self._needed(problem) if settled and more < MAX_MORE else None
            if number == ROUNDS or (settled and added is None):
                break
            if added is not None:
                free, more = sorted([*free, added]), more + 1
            last = _relaxed(moved, last)
            nearby = self._moved(nearby, last, free)
        return self._ended(problem, end, before, number, settled=settled)

    def _from_far(
        self, response: ElectronicsResponse, nearby: Nearby, free: Sequence[int]
    ) -> tuple[JointProblem, Parabola]:
        """First fit, to some of the pulses, with wider functions first."""
        at = None
        for wider in (*WIDER, 1.0):
            functions = first(self._wide(wider))
            problem = self._problem(response, nearby, free, functions, held=True, at=at)
            end = problem.fitted()
            response, at = problem.parameters.chain.response, problem.parameters.coordinates
        return problem, end

    @property
    def simulations(self) -> int:
        """Number of simulations of a usual search, for the remaining time.

        Derivatives take two each: of the first parameters, of all, and for other physics.
        """
        others = 0 if self.chosen else MAX_OTHERS * (1 + 2 * len(self._first))
        return USUAL_ROUNDS + 3 + 2 * (len(self._first) + self._n) + others

    @property
    def _n(self) -> int:
        return len(self.simulator.physics.nuisances)

    def _chain(self) -> ElectronicsResponse:
        """Fit of the chain alone, with the physics as simulated."""
        fitter = Fitter(self.recipe.matching.training)
        few = [sides.of(fitter.training.search_pulses) for sides in self._sides]
        return fit_chain(copy.deepcopy(self._start), few, fitter).response

    def _wide(self, wider: float) -> list[SlicedJoint]:
        both = zip(self._sides, self._bands, strict=True)
        return [SlicedJoint(sides, wider, band) for sides, band in both]

    def _problem(
        self,
        response: ElectronicsResponse,
        nearby: Nearby,
        free: Sequence[int],
        functions: Sequence[SlicedJoint] = (),
        *,
        held: bool = False,
        at: Values | None = None,
        weights: Sequence[Values] = (),
    ) -> JointProblem:
        """Comparison near the point at which pulses were simulated."""
        response, physics = copy.deepcopy(response), self.simulator.physics
        at = nearby.centre if at is None else at
        chain = response, physics, at, free, self.given, self._start
        parameters = JointParameters(*chain, self._modes)
        sets = parameters, functions or self._functions, nearby
        return JointProblem(*sets, self.recipe, self.knowledge, held, weights)

    def _deviated(self, problem: JointProblem) -> ElectronicsResponse | None:
        """The chain with deviations of its step response, if these physics leave too much.

        Physics would absorb a part of it: an early decay between the fixed ones looks like more
        self-repulsion, and so does a ringing.
        """
        mean, spread = problem.by_chance
        if problem.chi_square() < mean + BEYOND_CHANCE * spread:
            return None
        chain = with_settings(problem.parameters.chain.response, deviations=False)
        sides = [functions.sides for functions in problem.here()]
        deviated = with_deviations(chain, sides, lambda _: None)
        if not deviated.response.config.deviations:
            return None
        self._modes = deviated.modes
        return deviated.response

    def _first_free(self, response: ElectronicsResponse, nearby: Nearby) -> list[int]:
        """Parameters that are free initially."""
        if self.chosen:
            return self._all
        problem = self._problem(response, nearby, self._first, first(self._functions))
        information, selection = self._looked(problem)
        return [self._first[i] for i in selection.begin(information)]

    def _moved(
        self, nearby: Nearby, moved: Values, free: Sequence[int], reaches: float = 1.0
    ) -> Nearby:
        """Pulses at the moved coordinates, with moves limited to `FARTHEST` times the reach.

        Derivatives are simulated again beyond so many reaches.
        """
        nuisances = self.simulator.physics.nuisances
        farthest = FARTHEST * np.array([nuisance.reach for nuisance in nuisances])
        move = np.clip(moved, -farthest, farthest)
        for _ in range(HALVINGS):
            try:
                place = nearby.moved(nearby.centre + move)
                break
            except CpunetError as error:  # for example, if the detector is not depleted
                log.info(f"{error}; going half as far")
                move = 0.5 * move
        else:
            raise CpunetError(
                f"detector {self.simulator.physics.detector.name}: the data ask for physics "
                "that cannot be simulated; narrow a `prior`, or leave a parameter out of `free`"
            )
        outdated = place.outdated(free, reaches * farthest / FARTHEST)
        return place.again(outdated) if outdated else place

    def _needed(self, problem: JointProblem) -> int | None:
        """Fixed parameter that held-out pulses need most, if significant."""
        if self.chosen:
            return None
        selection, free = self._examined(problem)[2], problem.parameters.free
        falls = {
            i: selection.score(free) - selection.score([*free, i])
            for i in self._all
            if i not in free
        }
        best = max(falls, key=lambda i: falls[i], default=None)
        return best if best is not None and falls[best] > NEEDED else None

    def _examined(
        self, problem: JointProblem
    ) -> tuple[dict[int, float], Information, Selection]:
        """Expected decreases of chi-square for fixed parameters, and about all of them."""
        parameters = problem.parameters
        fixed = [i for i in self._all if i not in parameters.free]
        missing = problem.nearby.unknown(fixed)
        few = first(self._functions, LOOKED_AT_WITH)
        if missing:
            problem.nearby = problem.nearby.again(missing, events(few))
        chain, at = parameters.chain.response, parameters.coordinates
        whole = self._problem(chain, problem.nearby, self._all, few, at=at)
        information, selection = self._looked(whole)
        here, _ = selection.cost(parameters.free)
        falls = {i: here - selection.cost([*parameters.free, i])[0] for i in fixed}
        return falls, information, selection

    def _looked(self, problem: JointProblem) -> tuple[Information, Selection]:
        """What all pulses, and each half of them, tell of the free parameters."""
        parameters, vector = problem.parameters, problem.parameters.vector()
        residuals, jacobian, _ = problem.both(vector)
        halves = []
        for k in range(2):
            half = [functions.some(slice(k, None, 2)) for functions in problem.functions]
            halves.append(problem.of_parts(half).residuals(vector))
        selection = Selection(
            jacobian,
            residuals,
            np.array(halves)[:, : problem.moments],
            parameters.coordinates[parameters.free],
        )
        return Information.of(problem, jacobian), selection

    def _alternatives(
        self, problem: JointProblem, selection: Selection
    ) -> list[tuple[JointProblem, Parabola]]:
        """Fits of other sets of parameters that may explain the pulses as well."""
        if self.chosen:
            return []
        free = problem.parameters.free
        here, _ = selection.cost(free)
        forecast = [(*selection.cost(other), other) for other in selection.others(free)]
        forecast.sort(key=lambda forecasts: forecasts[0])
        fits = []
        for cost, place, other in forecast[:MAX_OTHERS]:
            if cost - here > LIKELY:
                break
            is_free = np.isin(np.arange(self._n), other)
            fit, nearby = problem, problem.nearby
            try:
                for _ in range(OTHER_ROUNDS):
                    move = np.where(is_free, place, 0) - nearby.centre
                    nearby = self._moved(nearby, move, other, np.inf)
                    chain = fit.parameters.chain.response
                    fit = self._problem(chain, nearby, other, weights=problem.weights)
                    minimum = fit.fitted()
                    place = fit.parameters.coordinates
                    if _settled(fit, minimum, place - nearby.centre):
                        break
            except CpunetError:  # these physics cannot be simulated
                continue
            if not place[~is_free].any():  # all that is not free is as simulated
                fits.append((fit, minimum))
        return fits

    def _ended(
        self,
        problem: JointProblem,
        end: Parabola,
        before: JointProblem,
        rounds: int,
        *,
        settled: bool,
    ) -> Calibrated:
        promised, information, selection = self._examined(problem)
        fits = [(problem, end), *self._alternatives(problem, selection)]
        best = min(fits, key=lambda fit: fit[1].cost)
        if best[1].cost < end.cost - NEEDED:
            problem, end = best
            promised, information, _ = self._examined(problem)
        before = replace(before, weights=problem.weights)
        mean, spread = problem.by_chance
        # errors grow by the root of chi-square over its upper limit by chance (two sigmas)
        scale = float(np.sqrt(max(1.0, problem.chi_square() / (mean + 2 * spread))))
        move, covariance = of_events(problem, scale)
        parameters = problem.parameters
        moved = np.clip(parameters.vector() + move, parameters.low, parameters.high)
        parameters.set(moved)
        rises = [(fit, minimum.cost - end.cost) for fit, minimum in fits]
        rises.sort(key=lambda fit: fit[1])
        return Calibrated(
            problem=problem,
            covariance=covariance,
            chi_square_before=before.chi_square(),
            pulls_before=before.pulls(),
            chi_square=problem.chi_square(),
            scale=scale,
            information=information,
            promised=promised,
            rounds=rounds,
            settled=settled,
            alternatives=[fit for fit in rises if fit[0] is not problem and fit[1] < SAME],
        )

    def _tell(self, when: str, problem: JointProblem, end: Parabola | None = None) -> None:
        parameters, physics = problem.parameters, self.simulator.physics
        per = problem.chi_square() / problem.moments
        words = [f"{when}: chi-square {per:.2f} per function"]
        errors = np.empty(0) if end is None else _errors(problem, end)
        for i, error in zip(parameters.free, errors, strict=True):
            value, own = physics.in_own_unit(i, float(parameters.coordinates[i]), error)
            words.append(f"{physics.nuisances[i].name} {value:.4g} ± {own:.2g}")
        log.info(", ".join(words))


def _errors(problem: JointProblem, end: Parabola) -> Values:
    """Standard deviations of the free coordinates."""
    parameters = problem.parameters
    covariance = np.linalg.inv(end.information + np.diag(parameters.widths**-2.0))
    return np.asarray(np.sqrt(covariance.diagonal())[parameters.n_chain :])


def _relaxed(moved: Values, last: Values) -> Values:
    """Damp moves that change sign, by linear interpolation with the previous moves.

    Where pulses are far from linear, a search oscillates around its solution.
    """
    back = moved * last < 0
    share = np.ones(len(moved))
    share[back] = 1 / (1 + np.abs(moved[back] / last[back]))
    return share * moved


def _settled(problem: JointProblem, end: Parabola, moved: Values) -> bool:
    """Whether all coordinates have moved by a small fraction of their errors."""
    moves = np.abs(moved[problem.parameters.free])
    return bool((moves < SETTLED * _errors(problem, end)).all())
