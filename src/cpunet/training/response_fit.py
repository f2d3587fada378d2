"""Fit a readout to unpaired pulses: a chain of few parameters, then any step response.

The parameters of a chain are those for which translated and measured pulses agree best in all
that is compared (`cpunet.training.chain_fit`).  What no such chain does is learned as
deviations of its step response (`cpunet.training.deviations`), if the pulses ask for them.

Every sample decides whether that is good (`cpunet.training.verdict`).  If it is not, and pulses
begin differently than simulated, the drift of the charges is stretched.

The current amplitude is what users cut on.  Its error is also given as the shift of
the current amplitude (A of A/E) that would best match the translated distribution to the data.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.training.chain_fit import (
    Fitted,
    Fitter,
    by_name,
    chi_square,
    fit_chain,
    with_decay,
    with_settings,
)
from cpunet.training.deviations import with_deviations
from cpunet.training.heights import with_heights
from cpunet.training.pulse_sets import SINGLE, PulseSets, Sides
from cpunet.training.verdict import DRIFT, FitInfo, Verdict, stretched, verdict

# What stretches the drift must lower chi-square of held-out pulses by this much.  Drift that is
# longer or shorter by more than a third is that of another detector.
NEEDED, MAX_STRETCH = 16.0, 1 / 3
BY_HEIGHT = "slew rate and curve"


class _Learned(NamedTuple):
    """A chain, the response with its deviations, if any, and what every sample says of it."""

    chain: Fitted
    response: ElectronicsResponse
    checks: Verdict
    info: FitInfo


def fit_response(
    sets: PulseSets, fitter: Fitter, start_from: ElectronicsResponse | None = None
) -> tuple[ElectronicsResponse, FitInfo]:
    """Fit a response to unpaired prepared pulses.

    Parameters
    ----------
    sets
        Pulses of both sides.
    fitter
        Settings of the fits; counts their steps.
    start_from
        Response of a similar readout, with the recipe's configuration, to start from.  The
        recipe's own starts are tried only if that fails.

    Raises
    ------
    CpunetError
        If the pulses are too few, or the fit does not find a finite chi-square.
    """
    bands, chains = sets.sides(), list[Fitted]()
    config, training = sets.recipe.matching
    starts = [] if start_from is None else [copy.deepcopy(start_from)]
    for factor in training.start_factors:
        starts.append(ElectronicsResponse(config, sets.noise.dt_ns))
        starts[-1].log_poles_ns += math.log(factor)
    for start in starts:
        chains.append(fit_chain(with_decay(start, sets.tail_slope), bands, fitter))
        if not chains[-1].poor:
            break  # no other valley to search for
    nearest = min(chains, key=lambda chain: chain.chi_square)
    # pulses that are collected late, or on the tail of another, do not pass cuts
    bands = [sides.cut_like_data(nearest.response) for sides in bands]
    if not nearest.poor:
        nearest = fit_chain(nearest.response, bands, fitter, search=False)
    best = _learned(nearest, bands, fitter)
    # of few pulses, the onset is not off for sure, but nothing else is either
    if not best.checks.good and (not best.checks.off or "onset" in best.checks.off):
        longer = _stretched(best.chain, bands, fitter)
        if longer is not None:
            other = _with_single_sites(_learned(longer, bands, fitter), sets, bands, fitter)
            best = min(best, other, key=lambda learned: learned.checks.chi_square)

    response, info, covariance = best.response, best.info, best.chain.covariance
    total, functions = chi_square(response, bands)
    fitter.count(total)
    shift, error = info.amplitude_shift or 0.0, info.amplitude_shift_error or 0.0
    values, parts, amplitude = response.describe(), [str(best.checks)], "the current amplitude"
    if abs(shift) >= 2 * error:
        parts.append(f"{amplitude} is off by {100 * shift:+.2f} ± {100 * error:.2f} %")
    elif best.checks.good:  # else, that the shift is small does not make the shape right
        parts.append(f"{amplitude} has a statistical error of {100 * error:.2g} % (1σ)")
    facts = {
        "verdict": "; ".join(parts + stretched(values, fitter.gains)),
        "chi_square": total,
        "moments": round(functions),
        "steps": fitter.steps,
        "parameters": values,
        "errors": by_name(best.chain.response, np.sqrt(covariance.diagonal())),
        "covariance": covariance.tolist(),
        "delay_ns": response.delay_ns(),
        "gains": fitter.gains,
        "in_no_band": {
            "sim": len(sets.sim) - sum(len(band.sim) for band in sets.bands),
            "data": len(sets.data) - sum(len(band.data) for band in sets.bands),
        },
    }
    return response, info.model_copy(update=facts)


def _learned(chain: Fitted, bands: Sequence[Sides], fitter: Fitter) -> _Learned:
    """Learn what a chain does not do, by the height of a pulse if heights differ."""
    response = chain.response
    around = [sides.entering(response) for sides in bands]
    alone = _Learned(chain, response, *verdict(response, around))
    # behind a stretched drift, deviations would make up for what is left of other physics
    linear = response.drift is None and response.by_height is None
    if not chain.poor and (alone.checks.clear if linear else alone.checks.good):
        return alone
    tried = list[_Learned]()
    if linear and len(bands) > 1 and not alone.checks.good:
        shaped, fitter.gains[BY_HEIGHT] = with_heights(response, bands, fitter.count)
        tried += [] if shaped is None else [_learned(shaped, bands, fitter)]
        if tried and tried[0].checks.good:
            return tried[0]
    deviated, _ = with_deviations(response, around, fitter.count)
    around = [sides.entering(deviated) for sides in bands]
    tried.append(_Learned(chain, deviated, *verdict(deviated, around)))
    return min(tried, key=lambda learned: learned.checks.chi_square)


def _stretched(chain: Fitted, bands: Sequence[Sides], fitter: Fitter) -> Fitted | None:
    """Stretch the drift, by a factor that may change with time, as far as that gains.

    Chi-squares are those of either half of the pulses when fitted to the other.
    """
    best, halves = None, [[sides.some(slice(k, None, 2)) for sides in bands] for k in range(2)]
    for terms in range(1, fitter.training.drift_terms + 1):
        before, held_out = (best or chain).response, list[float]()
        start = with_settings(before, drift_terms=terms)
        tried = fit_chain(start, bands, fitter, search=terms == 1)
        assert tried.response.drift is not None
        for response in (before, tried.response):
            held_out.append(0.0)
            for fitted, held in (halves, halves[::-1]):
                again = fit_chain(copy.deepcopy(response), fitted, fitter, search=False)
                held_out[-1] += chi_square(again.response, held)[0]
        sane = np.abs(tried.response.drift.stretch).max() < MAX_STRETCH
        gains = bool(held_out[0] - held_out[1] > NEEDED and sane)
        text = f"chi-square of held-out pulses {held_out[0]:.0f} → {held_out[1]:.0f}"
        fitter.gains[DRIFT[terms]] = f"{'gains' if gains else 'left out'}; {text}"
        if not gains:
            break
        best = tried
    return best


def _with_single_sites(
    learned: _Learned, sets: PulseSets, bands: Sequence[Sides], fitter: Fitter
) -> _Learned:
    """Fit the single sites of the continuum, too, unless the line then is bad.

    If the simulated drift is wrong, so are the charge clouds.  Nearly all pulses of a line have
    many sites, whose clouds are smaller than those of single sites; their sharp peak decides.
    """
    if not (single := sets.single_sites()):
        return learned
    start = copy.deepcopy(learned.chain.response)
    chain = fit_chain(start, bands, fitter, search=False, single=single)
    tried = _learned(chain, bands, fitter)
    used = tried.checks.good >= learned.checks.good
    fitter.gains[SINGLE] = f"{'used' if used else 'left out'}; {tried.checks}"
    return tried if used else learned
