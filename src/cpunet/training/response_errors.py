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
        Standard deviation by name, of numbers that are defined at both ends of every axis;
        empty if the covariance does not match the parameters.
    """
    moved = copy.deepcopy(response)
    parameters = Parameters(moved)
    centre = parameters.vector()
    try:
        matrix = np.asarray(covariance, float)
    except ValueError:  # rows of different lengths
        return {}
    if matrix.shape != (len(centre),) * 2 or not np.isfinite(matrix).all():
        return {}
    variances, axes = np.linalg.eigh(matrix)
    ends = []
    for axis in (np.sqrt(np.maximum(variances, 0)) * axes).T:
        for end in (centre + axis, centre - axis):
            parameters.set(end)
            ends.append(numbers(moved))
    errors: Numbers = {}
    for name in ends[0]:
        if all(name in end for end in ends):
            values = np.array([end[name] for end in ends])
            half = 0.5 * (values[::2] - values[1::2])
            errors[name] = float(np.sqrt(sum(half**2)))
    return errors


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
