"""Search for a ringing of the readout, and its frequency.

A fit does not find the frequency of a ringing from a distant start: chi-square as a function
of the frequency has many valleys.  But pulses depend nearly linearly on the two weights of the
ringing.  The best weights for each frequency on a grid, and the expected chi-square, therefore
follow from the derivatives at zero weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.response_problem import ResponseProblem


def most_promising_ringing(
    problem: ResponseProblem, frequencies_mhz: Sequence[float]
) -> tuple[ElectronicsResponse | None, float]:
    """Look for the ringing that would lower chi-square most.

    Parameters
    ----------
    problem
        Problem of a fitted response without ringing.
    frequencies_mhz
        Frequencies to try.

    Returns
    -------
    response
        A copy of the response with a ringing of the best frequency and zero weights; None if
        there are no frequencies.
    promised
        Chi-square expected with it, to first order.
    """
    vector = problem.parameters.vector()
    problem.clip = None
    deviations = problem.deviations(vector)
    known = problem.derivatives(vector, deviations, range(len(vector)))
    best: tuple[ElectronicsResponse | None, float] = (None, float(deviations @ deviations))
    for frequency in frequencies_mhz:
        response = _ringing_copy(problem.response, frequency)
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


def _ringing_copy(response: ElectronicsResponse, frequency_mhz: float) -> ElectronicsResponse:
    """A copy of a response with a ringing of a given frequency and zero weights."""
    config = response.config.model_copy(update={"ringing_mhz": frequency_mhz})
    rings = ElectronicsResponse(config, float(response.dt_ns))
    state = {n: v for n, v in response.state_dict().items() if "ringing" not in n}
    rings.load_state_dict(state, strict=False)
    rings.decay_known = response.decay_known
    return rings
