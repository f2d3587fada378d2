"""What the errors of a fit do to translated pulses.

The parameters of a readout are as certain as their covariance says.  Some pulses are
translated again with the parameters at both ends of each axis of the error ellipsoid, with
the same noise: half of the difference along an axis is one standard deviation of whatever is
calculated of them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.parameters import Values
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.training.closed_forms import error_ends
from cpunet.training.run import Run
from cpunet.translation.backends import ResponseBackend
from cpunet.translation.translator import REN
from cpunet.validation.peaks import PeakSets

PULSES = 300  # of a peak, for which an effect is calculated

Ends = Sequence[tuple[REN, REN]]


def fit_ends(run: Run, ren: REN) -> Ends:
    """A translator at both ends of each axis of the errors; none of a network."""
    backend = ren.backend
    if run.fit is None or not isinstance(backend, ResponseBackend):
        return []

    def at(response: ElectronicsResponse) -> REN:
        moved = copy.copy(ren)
        moved.backend = of_end = copy.copy(backend)
        chain = copy.copy(backend.network)
        chain.response = response
        of_end.network = chain
        return moved

    response = backend.network.response
    return [(at(a), at(b)) for a, b in error_ends(response, run.fit.covariance)]


def moved_values(peak: PeakSets, ends: Ends, seed: int) -> dict[str, Values]:
    """Parameters of some pulses of a peak at both ends of each axis.

    Parameters
    ----------
    peak
        Pulses of the peak.
    ends
        See `fit_ends`.
    seed
        Seed of the noise, the same everywhere.

    Returns
    -------
    dict
        By name, shape ``(axes, 2, pulses)``; empty without axes or pulses.
    """
    rows = peak.rows["ren"]
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), PULSES)).astype(int)]
    if not ends or not len(rows):
        return {}
    windows = peak.translations.windows["raw"][rows]
    kev, by_end = peak.translations.energy_kev["ren"][rows], []
    for ren in (ren for pair in ends for ren in pair):
        moved = ren.apply(windows, energy_kev=kev, generator=np.random.default_rng(seed))
        pulses, recipe = Pulses.of(moved, dt_ns=ren.dt_ns), ren.recipe
        by_end.append(all_parameters(pulses, recipe.preparation, recipe.scores))
    shape = len(ends), 2, len(rows)
    return {name: np.reshape([values[name] for values in by_end], shape) for name in by_end[0]}
