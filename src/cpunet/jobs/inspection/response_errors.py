"""Errors of what follows from a response: rise, missing charge, effective decay.

Parameters trade places: of two nearly equal poles neither is known, nor is a long decay beside
a fast one.  Their rise and their common decay are.  So errors of such numbers follow from the
parameters' whole covariance, along each of its axes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import numpy as np

from cpunet.networks.response import ElectronicsResponse
from cpunet.training.response_problem import Parameters

Numbers = dict[str, float]


def propagated(
    response: ElectronicsResponse,
    covariance: Sequence[Sequence[float]],
    numbers: Callable[[ElectronicsResponse], Numbers],
) -> Numbers:
    """Standard deviations of numbers of a response.

    Parameters
    ----------
    response
        As it was fitted.
    covariance
        Of its parameters, in the order of its vector.
    numbers
        What is wanted of a response.

    Returns
    -------
    dict
        Of each number, half its difference between both ends of each axis of the error
        ellipsoid, added in squares; empty if the covariance is not that of the parameters.
    """
    moved = copy.deepcopy(response)
    parameters = Parameters(moved)
    centre, matrix = parameters.vector(), np.asarray(covariance, float)
    if matrix.shape != (len(centre),) * 2 or not np.isfinite(matrix).all():
        return {}
    variances, axes = np.linalg.eigh(matrix)
    squares: Numbers = {}
    for axis in (np.sqrt(np.maximum(variances, 0)) * axes).T:
        ends = []
        for sign in (1, -1):
            parameters.set(centre + sign * axis)
            ends.append(numbers(moved))
        for name in ends[0].keys() & ends[1].keys():
            half = 0.5 * (ends[0][name] - ends[1][name])
            squares[name] = squares.get(name, 0.0) + half**2
    return {name: float(np.sqrt(square)) for name, square in squares.items()}
