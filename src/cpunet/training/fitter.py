"""One fit of a response after another: common settings, and a common count of steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from cpunet.electronics.drawn_tails import KnownDecay
from cpunet.recipes.training_settings import MatchingConfig
from cpunet.training.levenberg_marquardt import Listener, levenberg_marquardt
from cpunet.training.moments import Values
from cpunet.training.response_problem import ResponseProblem

# Chi-square per moment, with as many pulses as are used to search for the valley, below which a
# fit has found the right one.  Outliers in the data and the ridge keep it above 1.
GOOD_FIT = 1.6
FOLLOWING = 4  # steps of a fit after a small change


class Fitted(NamedTuple):
    """A comparison at the minimum of a fit.

    Parameters
    ----------
    problem
        Comparison whose response was fitted.
    cost
        Sum of its squared residuals.
    covariance
        Covariance of its parameters.
    """

    problem: ResponseProblem
    cost: float
    covariance: Values

    @property
    def per_moment(self) -> float:
        """Sum of the squared residuals per moment."""
        return self.cost / self.problem.moments

    @property
    def poor(self) -> bool:
        """Whether the fit has not found its valley."""
        return self.per_moment >= GOOD_FIT


@dataclass(eq=False)
class Fitter:
    """Fit responses with the same settings, and count the steps of all fits.

    Parameters
    ----------
    training
        Settings of the fits.
    decay
        Main decay as known from pile-up tails, if it is.
    listener
        Called with the number of steps so far, and chi-square.
    seed
        Seed of the pulses that are held out.
    steps
        Number of steps so far.
    gains
        What held-out pulses say of each part that was tried.
    """

    training: MatchingConfig
    decay: KnownDecay | None = None
    listener: Listener | None = None
    seed: int = 0
    steps: int = 0
    gains: dict[str, str] = field(default_factory=dict)

    def follow(self, problem: ResponseProblem) -> Fitted:
        """Take a few steps from the current response, after a small change of the pulses."""
        return self.fit(problem, coarse=False, steps=FOLLOWING)

    def fit(
        self, problem: ResponseProblem, *, coarse: bool = True, steps: int | None = None
    ) -> Fitted:
        """Fit from the current response; `coarse` if it is far from the data."""

        def told(_step: int, chi_square: float) -> None:
            self.count(chi_square)

        found = levenberg_marquardt(problem, steps or self.training.steps, told, coarse=coarse)
        return Fitted(problem, found.cost, found.covariance)

    def count(self, chi_square: float) -> None:
        """Count a step, and report it."""
        self.steps += 1
        if self.listener is not None:
            self.listener(self.steps, chi_square)
