"""The search for chain and physics that explain the data together.

From a chain that was fitted to the simulation as it is, round after round: pulses are simulated
at the physics found, both are fitted to the data with pulses nearby, and so on until the
physics stay where they are.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cpunet.calibration.functions import SlicedFunctions
from cpunet.calibration.identifiability import Direction, Information, promises
from cpunet.calibration.joint_problem import JointParameters, JointProblem, fewest
from cpunet.calibration.nearby import Nearby, Simulator
from cpunet.calibration.nuisances import Values
from cpunet.errors import CpunetError
from cpunet.networks.response import ElectronicsResponse
from cpunet.recipes.schema import Recipe
from cpunet.training.levenberg_marquardt import Minimum, levenberg_marquardt
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_problem import ResponseProblem
from cpunet.training.response_starts import GOOD_FIT, ringing_if_better, start_response

Note = Callable[[str], None]

ROUNDS, STEPS, FIRST_STEPS = 8, 12, 20
# A search has ended when all coordinates move by less than this part of their error.
SETTLED = 0.4
# In one round no coordinate goes farther than so many times the reach of its slope, and where
# no pulses can be simulated, it goes half as far, so many times.
FARTHEST, HALVINGS = 1.5, 4
# A parameter that was left out becomes free if chi-square promises to fall by so much (five
# standard deviations); at most so many do.
NEEDED, MOST_MORE = 25.0, 3


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Chain and physics that explain the data.

    Parameters
    ----------
    problem
        Where the search has ended: chain, coordinates, functions, pulses.
    covariance
        Of its parameters; if chi-square per degree of freedom is above 1, times that.
    chi_square_before, pulls_before
        Of the chain alone, with the physics as simulated.
    chi_square
        With both.
    directions
        Of all physics looked at, best known first.
    promised
        By how much chi-square would fall if a parameter that was not free were.
    errors_all
        Errors of all coordinates looked at, if all of them were free.
    rounds, settled
        Of the search, and whether the physics stayed where they were in the last one.
    """

    problem: JointProblem
    covariance: Values
    chi_square_before: float
    pulls_before: Values
    chi_square: float
    directions: list[Direction]
    promised: dict[str, float]
    errors_all: dict[str, float]
    rounds: int
    settled: bool

    @property
    def response(self) -> ElectronicsResponse:
        """The chain."""
        return self.problem.parameters.chain.response

    @property
    def errors(self) -> Values:
        """Of the free coordinates."""
        n = self.problem.parameters.n_chain
        return np.asarray(np.sqrt(self.covariance.diagonal()[n:]))

    @property
    def scale(self) -> float:
        """By how much errors are larger than if all were explained: a root of chi-square."""
        return _scale(self.problem, self.chi_square)


@dataclass(eq=False)
class Search:
    """A search, round by round.

    Parameters
    ----------
    simulator
        Of the events, with all parameters that may become free.
    sets
        Both sides, prepared, in bands.
    energy_kev
        Of the events.
    recipe
        Of the chain.
    given
        Priors that are not the default's, value and error by name.
    known
        Deviations of what else is known of the coordinates.
    free
        Positions of the parameters that are free; None for those that the data tell.
    note
        Told of each round.
    """

    simulator: Simulator
    sets: PulseSets
    energy_kev: Values
    recipe: Recipe
    given: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    known: Callable[[Values], Values] = lambda _: np.empty(0)
    free: list[int] | None = None
    note: Note = lambda _: None

    def __post_init__(self) -> None:
        self._bands = self.sets.bands()
        self._functions = [SlicedFunctions(band.moments) for band in self._bands]
        nuisances = self.simulator.physics.nuisances
        self._looked_at = list(range(len(nuisances))) if self.free is None else list(self.free)
        self._first = [i for i in self._looked_at if self.free or nuisances[i].first]

    def plan(self) -> Information:
        """What the pulses tell of all that may become free, before any fit of it."""
        few = fewest(self._bands)
        nearby = Nearby.about(self.simulator, np.zeros(self._n), []).again(self._looked_at, few)
        problem = self._problem(self._chain(), nearby, self._looked_at)
        return Information.of(problem, _jacobian(problem))

    def run(self) -> Calibrated:
        """Search until the physics stay where they are.

        Raises
        ------
        CpunetError
            If pulses cannot be simulated as the detector is given.
        """
        nearby = Nearby.about(self.simulator, np.zeros(self._n), self._first)
        response = self._chain()
        before = self._problem(response, nearby, [], held=True)
        self._tell("as simulated", before)
        free = self._first_free(response, nearby)
        may_ring, more, last = True, 0, np.zeros(self._n)
        for number in range(1, ROUNDS + 1):
            problem = self._problem(response, nearby, free, held=number == 1)
            found = levenberg_marquardt(problem, STEPS, None, coarse=number == 1)
            self._tell(f"round {number}", problem, found)
            response = problem.parameters.chain.response
            moved = problem.parameters.coordinates - nearby.centre
            settled = number > 1 and _settled(problem, found, moved)
            if may_ring and (number == 1 or settled) and _poor(problem):
                rings = self._ringing(problem)
                may_ring = rings is None and not settled
                response, settled = rings or response, settled and rings is None
            added = self._needed(problem) if settled and more < MOST_MORE else None
            if settled and added is None:
                break
            if added is not None:
                free, more = sorted([*free, added]), more + 1
            last = _relaxed(moved, last)
            nearby = self._moved(nearby, last, free)
        return self._ended(problem, found, before, number, settled=settled)

    @property
    def _n(self) -> int:
        return len(self.simulator.physics.nuisances)

    def _chain(self) -> ElectronicsResponse:
        """The chain alone, with the physics as simulated; of some of the pulses."""
        config, training = self.recipe.matching
        bands = self.sets.bands(training.search_pulses)
        dt_ns = self.simulator.physics.settings.dt_ns
        blank = ResponseProblem(ElectronicsResponse(config, dt_ns), bands, draws=1)
        problem = blank.of(start_response(config, dt_ns, 1.0, blank.slope))
        levenberg_marquardt(problem, FIRST_STEPS, None)
        return problem.response

    def _problem(
        self,
        response: ElectronicsResponse,
        nearby: Nearby,
        free: Sequence[int],
        *,
        held: bool = False,
    ) -> JointProblem:
        """The comparison about where pulses were simulated."""
        parameters = JointParameters(
            copy.deepcopy(response), self.simulator.physics, nearby.centre, free, self.given
        )
        return JointProblem(
            parameters,
            self._bands,
            self._functions,
            nearby,
            self.energy_kev,
            self.recipe,
            self.known,
            held=held,
        )

    def _first_free(self, response: ElectronicsResponse, nearby: Nearby) -> list[int]:
        """Parameters that are free at first."""
        if self.free is not None:
            return list(self.free)
        problem = self._problem(response, nearby, self._first)
        told = Information.of(problem, _jacobian(problem)).told()
        return [self._first[i] for i in told]

    def _moved(self, nearby: Nearby, moved: Values, free: Sequence[int]) -> Nearby:
        """Pulses about where the coordinates have moved, but not out of all reach."""
        nuisances = self.simulator.physics.nuisances
        farthest = FARTHEST * np.array([nuisance.reach for nuisance in nuisances])
        move = np.clip(moved, -farthest, farthest)
        for _ in range(HALVINGS):
            try:
                there = nearby.moved(nearby.centre + move)
                break
            except CpunetError as error:  # as where the detector is not depleted
                self.note(f"{error}; going half as far")
                move = 0.5 * move
        else:
            raise CpunetError(
                f"detector {self.simulator.physics.detector.name}: the data ask for physics "
                "that cannot be simulated; narrow a --prior, or --fix a parameter"
            )
        reach = np.array([nuisance.reach for nuisance in nuisances])
        far = (np.abs(there.centre - nearby.simulated_at) > reach)[list(free)]
        short = any(len(there.slopes[i]) < len(there.base) for i in free)
        return there.again(free) if far.any() or short else there

    def _ringing(self, problem: JointProblem) -> ElectronicsResponse | None:
        """A chain that rings, if that explains much of what is left."""
        config, training = self.recipe.matching
        if config.ringing_mhz is not None:
            return None
        waveforms = problem.prepared(problem.parameters.coordinates).waveforms
        bands = [
            replace(band, sim=replace(band.sim, sim=waveforms[band.rows]))
            for band in self.sets.bands(training.search_pulses)
        ]
        chain = copy.deepcopy(problem.parameters.chain.response)
        plain = ResponseProblem(chain, bands, draws=1)
        found = levenberg_marquardt(plain, STEPS, None, coarse=False)
        if found.cost < GOOD_FIT * plain.moments:
            return None
        best, _ = ringing_if_better(plain, found, config, training, None)
        return best.response if len(best.response.ringing) else None

    def _needed(self, problem: JointProblem) -> int | None:
        """The parameter that chi-square asks for most, if it asks for any."""
        if self.free is not None:
            return None
        promised = self._promised(problem)[0]
        if not promised:
            return None
        best = max(promised, key=lambda i: promised[i])
        return best if promised[best] > NEEDED else None

    def _promised(self, problem: JointProblem) -> tuple[dict[int, float], Information]:
        """What parameters that are not free promise, and the information on all."""
        parameters = problem.parameters
        missing = [i for i in self._looked_at if i not in problem.nearby.slopes]
        if missing:
            problem.nearby = problem.nearby.again(missing, problem.few)
        whole = self._problem(parameters.chain.response, problem.nearby, self._looked_at)
        whole.parameters.coordinates = parameters.coordinates.copy()
        jacobian = _jacobian(whole)
        n, where = parameters.n_chain, whole.parameters.free
        free = [*range(n), *(n + where.index(i) for i in parameters.free)]
        residuals = whole.residuals(whole.parameters.vector())
        found = promises(jacobian, residuals, free)
        return {where[i - n]: fall for i, fall in found.items()}, Information.of(
            whole, jacobian
        )

    def _ended(
        self,
        problem: JointProblem,
        found: Minimum,
        before: JointProblem,
        rounds: int,
        *,
        settled: bool,
    ) -> Calibrated:
        before.weigh_like(problem)
        vector = before.parameters.vector()
        promised, information = self._promised(problem)
        nuisances = self.simulator.physics.nuisances
        chi_square = problem.chi_square(problem.parameters.vector())
        scale = _scale(problem, chi_square)
        return Calibrated(
            problem=problem,
            covariance=scale**2 * found.covariance,
            chi_square_before=before.chi_square(vector),
            pulls_before=before.pulls(vector),
            chi_square=chi_square,
            directions=information.directions(),
            errors_all=dict(
                zip(
                    (nuisance.name for nuisance in information.nuisances),
                    (scale * information.errors()).tolist(),
                    strict=True,
                )
            ),
            promised={nuisances[i].name: fall for i, fall in promised.items()},
            rounds=rounds,
            settled=settled,
        )

    def _tell(self, when: str, problem: JointProblem, found: Minimum | None = None) -> None:
        per = problem.chi_square(problem.parameters.vector()) / problem.moments
        told = [f"{when}: chi-square {per:.2f} per moment"]
        if found is not None:
            parameters, physics = problem.parameters, self.simulator.physics
            values = physics.values(parameters.coordinates)
            errors = np.sqrt(found.covariance.diagonal()[parameters.n_chain :])
            for i, error in zip(parameters.free, errors, strict=True):
                nuisance = physics.nuisances[i]
                value = values[nuisance.name]
                slope = nuisance.slope(physics.nominal(nuisance), value)
                told.append(f"{nuisance.name} {value:.4g} ± {slope * error:.2g}")
        self.note(", ".join(told))


def _scale(problem: JointProblem, chi_square: float) -> float:
    """Where chain and physics do not explain all, errors grow with the root of chi-square."""
    freedom = problem.moments - len(problem.parameters.vector())
    return float(np.sqrt(max(1.0, chi_square / freedom)))


def _jacobian(problem: JointProblem) -> Values:
    vector = problem.parameters.vector()
    return problem.jacobian(vector, problem.residuals(vector))


def _poor(problem: JointProblem) -> bool:
    return problem.chi_square(problem.parameters.vector()) > GOOD_FIT * problem.moments


def _relaxed(moved: Values, last: Values) -> Values:
    """Moves that turn back end where they and those before them would meet.

    Where pulses are far from in proportion, a search goes back and forth about its end.
    """
    back = moved * last < 0
    share = np.ones(len(moved))
    share[back] = 1 / (1 + np.abs(moved[back] / last[back]))
    return share * moved


def _settled(problem: JointProblem, found: Minimum, moved: Values) -> bool:
    """Whether the coordinates have moved by little of their errors."""
    parameters = problem.parameters
    errors = np.sqrt(found.covariance.diagonal()[parameters.n_chain :])
    return bool((np.abs(moved[parameters.free]) < SETTLED * errors).all())
