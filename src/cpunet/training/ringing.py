"""Does a readout ring, and how fast?

A ringing has a frequency, and from a start far from it a fit does not find it: chi-square
as a function of the frequency has many valleys.  Its two weights are nearly linear, so that
for each frequency on a grid the best of them, and the chi-square that they promise, follow
from derivatives where there is none yet.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.recipes.network_settings import ResponseConfig
from cpunet.training.response_problem import ResponseProblem


def most_promising_ringing(
    problem: ResponseProblem, config: ResponseConfig, frequencies_mhz: Sequence[float]
) -> tuple[ElectronicsResponse | None, float]:
    """Look for the ringing that would lower chi-square most.

    Parameters
    ----------
    problem
        Of a response without ringing, where its fit has ended.
    config
        Of that response.
    frequencies_mhz
        At which to look.

    Returns
    -------
    response
        A copy of the response with a ringing of the best frequency, of no size yet; None if
        there are no frequencies.
    promised
        Chi-square to be expected of it, to first order.
    """
    vector = problem.parameters.vector()
    problem.clip = None
    deviations = problem.deviations(vector)
    known = problem.derivatives(vector, deviations, range(len(vector)))
    best: tuple[ElectronicsResponse | None, float] = (None, float(deviations @ deviations))
    for frequency in frequencies_mhz:
        response = _ringing_copy(problem.response, config, frequency)
        tried = problem.of(response)
        weights = [i for i, label in enumerate(tried.parameters.labels) if label == "ringing"]
        slopes = tried.derivatives(tried.parameters.vector(), deviations, weights)
        columns = np.concatenate([known, slopes], axis=1)
        move = np.linalg.lstsq(columns, deviations)[0]
        left = deviations - columns @ move
        response.ringing.data.zero_()  # the derivatives moved it
        if float(left @ left) < best[1]:
            best = response, float(left @ left)
    return best


def _ringing_copy(
    response: ElectronicsResponse, config: ResponseConfig, frequency_mhz: float
) -> ElectronicsResponse:
    """The same response with a ringing of a frequency, and of no size."""
    rings = ElectronicsResponse(
        config.model_copy(update={"ringing_mhz": frequency_mhz}), float(response.dt_ns)
    )
    state = {n: v for n, v in response.state_dict().items() if "ringing" not in n}
    rings.load_state_dict(state, strict=False)
    rings.decay_known = response.decay_known
    return rings
