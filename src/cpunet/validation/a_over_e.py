"""The A/E cut as used by experiments, and how well a simulation predicts its survival.

A is the maximum current of a pulse, E its energy.  Events of the double-escape peak
(DEP) deposit their energy at one site, like the decay that is searched for.  The cut is
placed where 90 % of them survive.  A pulse-shape simulation must predict
what fraction of other peaks survives it.

Prepared pulses are normalised, so that `parameters.current_amplitude` is A/E already.
The slight dependence of A/E on the energy, which experiments correct for before the cut,
is left in: its physics is the same in data and simulation, and the survival is no test of it.
Only the low side is cut; events near the contacts have a high A/E and need another cut.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.validation.resampling import resampled_quantiles

Values = npt.NDArray[np.float64]
PeakTable = dict[str, dict[str, float | None]]

ACCEPTANCE = 0.9  # fraction of the DEP that survives
MIN_PULSES = 20  # events of the DEP: two below the cut
DEP = "DEP"  # the peak that defines the cuts
BOOTSTRAPS = 300


@dataclass(frozen=True)
class PeakSurvival:
    """Survival of one peak after the cut.

    Attributes
    ----------
    survival, std
        Survival and its error in percent; NaN without events.  The error combines those of
        the number of survivors and of the cut in quadrature.
    """

    survival: float
    std: float


@dataclass(frozen=True)
class Survival:
    """The cut and the survival of each peak.

    Attributes
    ----------
    cut, cut_std
        Lowest A/E that survives, in pulse heights per sample, and its error.
    peaks
        Survival of the other peaks.
    """

    cut: float
    cut_std: float
    peaks: dict[str, PeakSurvival]


def ae_survival(
    dep_ae: Values,
    others: Mapping[str, Values],
    *,
    bootstraps: int = BOOTSTRAPS,
    seed: int | np.random.Generator = 0,
) -> Survival:
    r"""Survival of other peaks after a low-A/E cut that keeps 90 % of the DEP.

    The acceptance is exact on average for *new* events of the same kind, however few events
    set the cut.

    .. math:: S = \frac{k}{n}, \qquad \sigma_S^2 = \sigma_k^2 + \sigma_c^2

    with :math:`k` of :math:`n` events at or above the cut :math:`c`, the 10 % quantile of the
    DEP.  :math:`\sigma_k` is the standard deviation of the posterior with a flat prior, and
    :math:`\sigma_c` the spread of :math:`S` over bootstraps of the cut.

    Parameters
    ----------
    dep_ae
        A/E of the events of the double-escape peak (DEP).  Values that are not finite are left
        out, here and below.
    others
        A/E of the events of other peaks or ranges, by name.  The DEP itself would survive with
        90 % by construction, and its error would be meaningless.
    bootstraps, seed
        Number and seed of the bootstraps of the DEP, for the error of the cut.

    Returns
    -------
    Survival
        Cut, and survival in percent by peak.

    Raises
    ------
    CpunetError
        If fewer than 20 events of the DEP have a finite amplitude.

    Examples
    --------
    Of 99 equidistant values the cut is the 10th, and 90 of the 99 survive:

    >>> ae = np.arange(1.0, 100.0)
    >>> found = ae_survival(ae, {"SEP": ae})
    >>> round(found.cut, 6), round(found.peaks["SEP"].survival, 2)
    (10.0, 90.91)
    """
    if bootstraps < 2:
        raise CpunetError(f"bootstraps is {bootstraps}; a spread needs 2 or more")
    dep = dep_ae[np.isfinite(dep_ae)]
    if dep.size < MIN_PULSES:
        raise CpunetError(
            f"{dep.size} events of the double-escape peak have an A/E; "
            f"a cut needs {MIN_PULSES} or more"
        )
    rng = np.random.default_rng(seed)
    # for this quantile the acceptance of new events is exact on average for any sample size
    cut = float(np.quantile(dep, 1 - ACCEPTANCE, method="weibull"))
    cuts = resampled_quantiles(dep, 1 - ACCEPTANCE, bootstraps, rng)
    return Survival(
        cut=cut,
        cut_std=float(cuts.std(ddof=1)),
        peaks={name: _peak_survival(values, cut, cuts) for name, values in others.items()},
    )


def survival_table(
    data: Mapping[str, Values],
    methods: Mapping[str, Mapping[str, Values]],
    *,
    bootstraps: int = BOOTSTRAPS,
    seed: int | np.random.Generator = 0,
) -> dict[str, PeakTable]:
    """Survival of each peak in data and simulations, each after its own cut.

    Since each dataset has its own cut, a wrong scale of A/E alone makes no difference.

    Parameters
    ----------
    data
        Measured A/E by peak.
    methods
        A/E by method and peak: ``{"raw": …, "ren": …}`` and any others.
    bootstraps, seed
        Number and seed of the bootstraps for the errors of the cuts.

    Returns
    -------
    dict
        For each peak, JSON-ready (``None`` where a number does not exist):

        ``events``, ``missing``
            number of events with and without a finite amplitude, by method and for the
            ``data``.
        ``cut``, ``cut_std``
            for the DEP only, by method and for the ``data``, in pulse heights per sample.
            The cut and all numbers derived from it are None if fewer than 20 events of the
            DEP have an amplitude.
        ``survival``, ``survival_std``
            for the other peaks in percent, by method and for the ``data``.
        ``difference``, ``difference_std``
            method minus data, in percentage points.
        ``sigma``
            difference divided by its error.

    Raises
    ------
    CpunetError
        If the data lack the DEP, or a method lacks a peak of the data.
    """
    if DEP not in data:
        raise CpunetError(f"the data lack peak {DEP}; the A/E cut needs it")
    for method, peaks in methods.items():
        if absent := data.keys() - peaks.keys():
            raise CpunetError(f"{method}: peak {min(absent)} is missing; translate it too")
    rng = np.random.default_rng(seed)
    sets = {"data": data, **methods}
    found: dict[str, Survival | None] = {}
    for method, peaks in sets.items():
        others = {name: peaks[name] for name in data if name != DEP}
        enough = np.isfinite(peaks[DEP]).sum() >= MIN_PULSES
        found[method] = (
            ae_survival(peaks[DEP], others, bootstraps=bootstraps, seed=rng) if enough else None
        )
    table: dict[str, PeakTable] = {}
    for name in data:
        finite = {m: int(np.isfinite(peaks[name]).sum()) for m, peaks in sets.items()}
        table[name] = {
            "events": {**finite},
            "missing": {m: len(peaks[name]) - finite[m] for m, peaks in sets.items()},
            **(_cut_rows(found) if name == DEP else _survival_rows(name, found)),
        }
    return table


def sideband_survival(
    peak_pass: int, peak: int, side_pass: int, side: int, scale: float
) -> tuple[float, float]:
    r"""Survival of a peak after subtraction of its background, estimated from sidebands.

    .. math:: S = \frac{p - \alpha \, s}{P - \alpha \, S_b}, \qquad
        \sigma_S^2 = \frac{(1 - S)^2 (p + \alpha^2 s) + S^2 (f + \alpha^2 f_b)}
        {(P - \alpha \, S_b)^2}

    with :math:`p` of :math:`P` events surviving in the range of the peak, :math:`s` of
    :math:`S_b` in the sidebands, :math:`f = P - p`, :math:`f_b = S_b - s` and the `scale`
    :math:`\alpha`.

    Parameters
    ----------
    peak_pass, peak
        Number of events in the range of the peak: survivors of the cut, and all.
    side_pass, side
        The same in the sidebands.
    scale
        Width of the peak's range divided by that of the sidebands.

    Returns
    -------
    tuple of float
        Survival and its error in percent, from the Poisson errors of surviving and removed
        events (binomial if `scale` is 0), without the error of the cut.  NaN if no event of
        the peak is left.

    Raises
    ------
    CpunetError
        If more events survive than there are, or a number is negative.

    Examples
    --------
    >>> survival, std = sideband_survival(150, 400, 100, 200, scale=0.5)
    >>> round(survival, 2), round(std, 2)
    (33.33, 3.47)
    """
    if not (0 <= peak_pass <= peak and 0 <= side_pass <= side and scale >= 0):
        raise CpunetError(
            f"{peak_pass} of {peak} events in the peak and {side_pass} of {side} beside it, "
            f"scaled by {scale}, cannot survive; give counts of 0 or more"
        )
    total = peak - scale * side
    if total <= 0:
        return float("nan"), float("nan")
    survival = (peak_pass - scale * side_pass) / total
    passing = peak_pass + scale**2 * side_pass
    failing = peak - peak_pass + scale**2 * (side - side_pass)
    # events that pass and that fail are independent; the sums of both are not
    variance = ((1 - survival) ** 2 * passing + survival**2 * failing) / total**2
    return 100 * survival, float(100 * np.sqrt(variance))


def survival_error(passing: int, n: int) -> float:
    """Standard deviation of the posterior of a survival (0 … 1) with a flat prior.

    Unlike a binomial error it is not 0 if none or all of the `n` events survive.
    """
    p = (passing + 1) / (n + 2)
    return float(np.sqrt(p * (1 - p) / (n + 3)))


def _peak_survival(values: Values, cut: float, cuts: Values) -> PeakSurvival:
    finite = np.sort(values[np.isfinite(values)])
    n = finite.size
    if not n:
        return PeakSurvival(float("nan"), float("nan"))
    passing = n - int(np.searchsorted(finite, cut))
    of_cut = (1 - np.searchsorted(finite, cuts) / n).std(ddof=1)
    error = float(100 * np.hypot(survival_error(passing, n), of_cut))
    return PeakSurvival(100 * passing / n, error)


def _cut_rows(found: Mapping[str, Survival | None]) -> PeakTable:
    return {
        "cut": {m: s.cut if s else None for m, s in found.items()},
        "cut_std": {m: s.cut_std if s else None for m, s in found.items()},
    }


def _survival_rows(name: str, found: Mapping[str, Survival | None]) -> PeakTable:
    values = {m: s.peaks[name].survival if s else np.nan for m, s in found.items()}
    errors = {m: s.peaks[name].std if s else np.nan for m, s in found.items()}
    methods = [m for m in found if m != "data"]
    difference = {m: values[m] - values["data"] for m in methods}
    std = {m: float(np.hypot(errors[m], errors["data"])) for m in methods}
    rows = {
        "survival": values,
        "survival_std": errors,
        "difference": difference,
        "difference_std": std,
        "sigma": {m: difference[m] / std[m] for m in methods},
    }
    return {
        row: {m: v if np.isfinite(v) else None for m, v in numbers.items()}
        for row, numbers in rows.items()
    }
