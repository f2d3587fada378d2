r"""Pulses of the same hits for physics close to those simulated.

A fit needs pulses for many sets of physics, and each simulation takes seconds. Pulses are
therefore simulated once on either side of a point and interpolated linearly in between,

.. math:: S(x) = S(x_0) + \sum_i (x_i - x_{0,i}) \frac{\partial S}{\partial x_i}.

Other drift velocities shift the end of a pulse by more than the width of its edge. Only shapes
aligned at half maximum change linearly. This loses no information, since no measured dataset
contains the start time of a pulse. Derivatives from another point are moved with the edge.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cpunet.calibration.nuisances import Physics, Values
from cpunet.simulation.hits import Hits
from cpunet.simulation.simulator import Simulator as DetectorSimulator
from cpunet.training.aligned import between, cubic, stretch

FloatArray = npt.NDArray[np.float32]
# Factors by which the sampling period is divided for alignment; the first possible is used.
FINER = (4, 5, 3, 2, 1)
# Root mean square of the moves of the edges, in samples, for which a derivative is moved along.
# A longer move loses shape between the samples: a third at half a sample.
MOVED = 0.15


def half_maxima(pulses: FloatArray, otherwise: Values | float = 0.0) -> Values:
    """Sample at which each pulse reaches half its final value; `otherwise` if it does not."""
    level, rows = 0.5 * pulses[:, -1:], np.arange(len(pulses))
    crossed = (pulses[:, 1:] >= level) & (level > pulses[:, :-1])
    before = crossed.argmax(axis=1)
    low, high = pulses[rows, before], pulses[rows, before + 1]
    part = (level[:, 0].astype(float) - low) / np.where(high > low, high - low, 1)
    return np.where(crossed.any(axis=1), before + part, otherwise)


def move(pulses: FloatArray, samples: Values) -> FloatArray:
    """Shift each pulse to the left by a number of samples, with cubic interpolation."""
    whole = np.floor(samples).astype(np.int64)
    weights, _ = cubic(samples - whole)
    return between(stretch(pulses, whole - 1, pulses.shape[1] + 3), weights)


@dataclass(eq=False)
class Simulator:
    """Simulation of events as a function of the coordinates of the physics.

    Parameters
    ----------
    hits
        Merged hits of the events, in an order in which any first part is representative.
    physics
        Detector and parameters that the coordinates refer to.
    simulated
        Called after each simulation.
    """

    hits: Hits
    physics: Physics
    simulated: Callable[[], None] = lambda: None

    @property
    def finer(self) -> int:
        """Number of fine samples per sample."""
        steps = self.physics.settings.dt_ns / self.physics.settings.step_ns
        return next(n for n in FINER if abs(steps / n - round(steps / n)) < 1e-9)

    def __call__(
        self, coordinates: Values, *, quick: bool = False, most: int | None = None
    ) -> FloatArray:
        """Pulses of the first `most` events, shape (events, samples).

        They are those of `cpunet simulate`; if `quick`, they are finely sampled.
        """
        detector, settings = self.physics.at(coordinates)
        if quick:
            settings = settings.model_copy(update={"dt_ns": settings.dt_ns / self.finer})
        events = DetectorSimulator(detector, settings, quick=quick).events(self.hits[:most])
        self.simulated()
        return events.waveforms


@dataclass(frozen=True, eq=False)
class Derivative:
    """Change of the pulses with a coordinate.

    Parameters
    ----------
    pulses
        Derivatives of the pulses, shape (events, samples).
    point
        Coordinates at which they were simulated.
    half
        Half maxima of the pulses at this point in samples, shape (events,).
    """

    pulses: FloatArray
    point: Values
    half: Values


@dataclass(frozen=True, eq=False)
class Nearby:
    """Pulses near a point of the physics.

    Parameters
    ----------
    simulator
        Simulation of the events.
    centre
        Coordinates of the point.
    base
        Pulses at the point, shape (events, samples).
    derivatives
        Derivatives by the position of the coordinate, simulated at the centre or close to it.
    """

    simulator: Simulator
    centre: Values
    base: FloatArray
    derivatives: Mapping[int, Derivative] = field(default_factory=dict)

    def again(self, of: Sequence[int], most: int | None = None) -> Nearby:
        """The same point, with some derivatives simulated anew for the first `most` events.

        Each is the difference of the aligned shapes of two simulations.
        """
        if not of:
            return self
        simulator, centre, derivatives = self.simulator, self.centre, {**self.derivatives}
        here, finer = simulator(centre, quick=True, most=most), simulator.finer
        half = half_maxima(here)
        for i in of:
            nuisance = simulator.physics.nuisances[i]
            low, high = nuisance.bounds(simulator.physics.nominal(nuisance))
            ends = [centre[i] - nuisance.step, centre[i] + nuisance.step]
            if ends[0] < low:  # not possible below: upwards only
                ends = [low, max(low, centre[i]) + 2 * nuisance.step]
            ends[1] = min(ends[1], high)
            shapes = []
            for end in ends:
                moved = centre.copy()
                moved[i] = end
                pulses = simulator(moved, quick=True, most=most)
                fine = move(pulses, half_maxima(pulses, half) - half)
                whole = fine[:, : fine.shape[1] // finer * finer].reshape(len(fine), -1, finer)
                shapes.append(whole.mean(axis=2, dtype=np.float32))
            slope = (shapes[1] - shapes[0]) / np.float32(ends[1] - ends[0])
            derivatives[i] = Derivative(slope, centre, self.half[:most])
        return replace(self, derivatives=derivatives)

    @cached_property
    def half(self) -> Values:
        """Half maxima of the pulses in samples."""
        return half_maxima(self.base)

    @cached_property
    def slopes(self) -> Mapping[int, FloatArray]:
        """Derivatives of these pulses by the position of the coordinate.

        Each is moved with the edge of its pulse.
        """
        return {
            i: move(of.pulses, of.half - self.half[: len(of.pulses)])
            for i, of in self.derivatives.items()
        }

    def outdated(
        self, of: Sequence[int], reach: Values | float = np.inf, least: int = 0
    ) -> list[int]:
        """Coordinates without derivatives from within reach, of at least so many events.

        Only distances along the coordinates `of` count. Derivatives are out of reach, too, if
        the edges of the pulses have moved.
        """
        outdated = []
        for i in of:
            known = self.derivatives.get(i)
            if known is not None and len(known.pulses) >= least:
                near = np.abs(self.centre - known.point) <= reach
                moved = self.half[: len(known.half)] - known.half
                if near[list(of)].all() and moved @ moved <= MOVED**2 * len(moved):
                    continue
            outdated.append(i)
        return outdated

    def at(self, coordinates: Values, most: int | None = None) -> FloatArray:
        """Pulses of the first `most` events at some coordinates, shape (events, samples)."""
        pulses = self.base[:most]
        for i, change in enumerate(coordinates - self.centre):
            if change and i in self.slopes:
                pulses = pulses + np.float32(change) * self.slopes[i][:most]
        return pulses
