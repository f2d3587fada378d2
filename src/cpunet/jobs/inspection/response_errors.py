"""Errors of derived numbers of a response: rise time, missing charge, effective decay.

Parameters can be degenerate: two nearly equal poles are individually unconstrained, as is a
long decay beside a fast one, while their rise time and common decay are well known.  Errors of
derived numbers are therefore propagated with the full covariance of the parameters, along each
of its axes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.response_problem import Parameters

Numbers = dict[str, float]


def propagated(
    response: ElectronicsResponse,
    covariance: Sequence[Sequence[float]],
    numbers: Callable[[ElectronicsResponse], Numbers],
) -> Numbers:
    r"""Standard deviations of derived numbers of a response.

    .. math:: \sigma_f^2 = \sum_k \left[ \tfrac{1}{2} \left(
        f(p + \sigma_k e_k) - f(p - \sigma_k e_k) \right) \right]^2

    with the axes :math:`\sigma_k e_k` of the error ellipsoid of the parameters :math:`p`.

    Parameters
    ----------
    response
        Fitted response.
    covariance
        Covariance of its parameters, in the order of its vector.
    numbers
        Function that returns the derived numbers of a response by name.

    Returns
    -------
    dict
        Standard deviation by name; empty if the covariance does not match the parameters.
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
