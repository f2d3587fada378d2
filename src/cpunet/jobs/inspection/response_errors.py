"""Errors of a response: of its parameters, and of numbers derived from them.

Parameters can be degenerate: two nearly equal poles are individually unconstrained, as is a
long decay beside a fast one, while their rise time and common decay are well known.  Errors of
derived numbers are therefore propagated with the full covariance of the parameters, along each
of its axes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.response_problem import STRETCH, Parameters

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


def fitted_errors(response: ElectronicsResponse, errors: Mapping[str, float]) -> Numbers:
    """Errors of the fit under the names of `ElectronicsResponse.describe`."""
    poles, decay = response.log_poles_ns.detach().exp(), response.log_decay_us.exp().item()
    order = poles.argsort(descending=True).tolist()
    sources = {
        f"pole_{i + 1}_ns": (f"log_poles_ns.{k + 1}", float(poles[k]))
        for i, k in enumerate(order)
    }
    sources["decay_us"] = ("log_decay_us.1", decay)
    if len(response.ringing):
        for i, value in enumerate(response.log_ringing.detach().exp().tolist()):
            name = ("ringing_mhz", "ringing_damping_ns")[i]
            sources[name] = (f"log_ringing.{i + 1}", value)
    for i, tau in enumerate(response.slow_ns.tolist()):
        sources[f"slow_{tau:g}_ns"] = (f"slow_weights.{i + 1}", 1.0)
    if response.drift is not None:
        for i, name in enumerate(response.drift.describe()):
            sources[name] = (f"{STRETCH}.{i + 1}", 1.0)
    free = response.config.free_decays
    for i, tau in enumerate(response.fast_times_us.tolist()):
        name = f"fast_decay_{i + 1}_share" if free else f"decay_{tau:g}_us"
        sources[name] = (f"decay_weights.{i + 1}", 1.0)
        if free:
            sources[f"fast_decay_{i + 1}_us"] = (f"log_fast_decays_us.{i + 1}", tau)
    return {
        name: scale * float(errors[source])
        for name, (source, scale) in sources.items()
        if source in errors
    }
