"""The cut on A/E as experiments use it, and how well a simulation predicts it.

A is the maximum current of a pulse, E its energy.  Events of the double-escape peak
(DEP) deposit their energy at one site, as the searched decay does: the cut is put
where a given fraction of them survives, and what it leaves of other peaks is the
figure that a pulse-shape simulation must predict.

Prepared pulses are normalised, so that `parameters.current_amplitude` is A/E already.
The slight dependence of A/E on the energy, which experiments take out before the cut,
is left in: it is the same physics in data and simulation, but it is not a test of it.
Only the low side is cut; events near the contacts have a high A/E and need another.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.analysis.resampling import resampled_quantiles
from cpunet.errors import CpunetError

Values = npt.NDArray[np.float64]
PeakTable = dict[str, dict[str, float | None]]

FEWEST = 20  # events of the DEP: two below a cut at 90 %
BOOTSTRAPS = 300


@dataclass(frozen=True)
class PeakSurvival:
    """What the cut leaves of one peak.

    Attributes
    ----------
    survival, std
        In percent; NaN without events.  The error has two parts in quadrature, that
        of the number of survivors and that of the cut.
    n, missing
        Events with an amplitude, and events left out because theirs is not finite.
    """

    survival: float
    std: float
    n: int
    missing: int


@dataclass(frozen=True)
class Survival:
    """The cut and what it leaves of each peak.

    Attributes
    ----------
    cut, cut_std
        Lowest A/E that survives, in pulse heights per sample, and its error.
    n, missing
        Events from which the cut comes, and those without a finite amplitude.
    peaks
        Survival of the other peaks.
    """

    cut: float
    cut_std: float
    n: int
    missing: int
    peaks: dict[str, PeakSurvival]


def ae_survival(
    dep_ae: Values,
    others: Mapping[str, Values],
    acceptance: float = 0.9,
    *,
    bootstraps: int = BOOTSTRAPS,
    seed: int | np.random.Generator = 0,
) -> Survival:
    """Cut on a low A/E that a given fraction of the DEP survives, applied to other peaks.

    Parameters
    ----------
    dep_ae
        A/E of the events of the double-escape peak.
    others
        A/E of the events of other peaks or ranges, by name.  The DEP itself would
        survive with `acceptance` by construction; its error would mean nothing.
    acceptance
        Fraction of the DEP that survives, above 0 and below 1.  It is that of *new*
        events of the same kind on average, also if there are few.
    bootstraps, seed
        Of the DEP's events, for the error of the cut.

    Returns
    -------
    Survival
        The cut, and survival in percent by peak.

    Raises
    ------
    CpunetError
        If `acceptance` is no such fraction, or fewer than 20 events of the DEP have a
        finite amplitude.
    """
    if not 0 < acceptance < 1:
        raise CpunetError(f"acceptance is {acceptance}; give a fraction such as 0.9")
    if bootstraps < 2:
        raise CpunetError(f"bootstraps is {bootstraps}; a spread needs 2 or more")
    dep = dep_ae[np.isfinite(dep_ae)]
    if dep.size < FEWEST:
        raise CpunetError(
            f"{dep.size} events of the double-escape peak have an A/E; "
            f"a cut needs {FEWEST} or more"
        )
    rng = np.random.default_rng(seed)
    cut = _cut(dep, acceptance)
    cuts = resampled_quantiles(dep, 1 - acceptance, bootstraps, rng)
    return Survival(
        cut=cut,
        cut_std=float(cuts.std(ddof=1)),
        n=dep.size,
        missing=len(dep_ae) - dep.size,
        peaks={name: _peak_survival(values, cut, cuts) for name, values in others.items()},
    )


def survival_table(
    data: Mapping[str, Values],
    methods: Mapping[str, Mapping[str, Values]],
    acceptance: float = 0.9,
    *,
    dep: str = "DEP",
    bootstraps: int = BOOTSTRAPS,
    seed: int | np.random.Generator = 0,
) -> dict[str, PeakTable]:
    """Survival of each peak in data and simulations, each of them after its own cut.

    As each set has its own cut, a wrong scale of A/E alone makes no difference here.

    Parameters
    ----------
    data
        Measured A/E by peak.
    methods
        The same by method: ``{"raw": …, "ren": …}`` and any others.
    acceptance
        Fraction of the DEP that survives.
    dep
        Name of the peak from which the cuts come.
    bootstraps, seed
        Of the errors of the cuts.

    Returns
    -------
    dict
        For each peak, JSON-ready (``None`` where a number does not exist):

        ``events``, ``missing``
            how many events have an amplitude and how many do not, by method and for
            the ``data``.
        ``cut``, ``cut_std``
            of the DEP only, by method and for the ``data``; in pulse heights per
            sample.  None, as all that follows from it, if fewer than 20 events of the
            DEP have an amplitude.
        ``survival``, ``survival_std``
            of the other peaks in percent, by method and for the ``data``.
        ``difference``, ``difference_std``
            method less data, in percentage points.
        ``sigma``
            the difference in units of its error.

    Raises
    ------
    CpunetError
        If the data lack the DEP, or a method a peak of the data.
    """
    if dep not in data:
        raise CpunetError(f"the data lack peak {dep}; the A/E cut needs it")
    for method, peaks in methods.items():
        if absent := data.keys() - peaks.keys():
            raise CpunetError(f"{method}: peak {min(absent)} is missing; translate it too")
    rng = np.random.default_rng(seed)
    sets = {"data": data, **methods}
    found: dict[str, Survival | None] = {}
    for method, peaks in sets.items():
        others = {name: peaks[name] for name in data if name != dep}
        enough = np.isfinite(peaks[dep]).sum() >= FEWEST
        found[method] = (
            ae_survival(peaks[dep], others, acceptance, bootstraps=bootstraps, seed=rng)
            if enough
            else None
        )
    table: dict[str, PeakTable] = {}
    for name in data:
        finite = {m: int(np.isfinite(peaks[name]).sum()) for m, peaks in sets.items()}
        table[name] = {
            "events": {**finite},
            "missing": {m: len(peaks[name]) - finite[m] for m, peaks in sets.items()},
            **(_cut_rows(found) if name == dep else _survival_rows(name, found)),
        }
    return table


def sideband_survival(
    peak_pass: int, peak: int, side_pass: int, side: int, scale: float
) -> tuple[float, float]:
    """Survival of a peak after its background, seen beside it, was subtracted.

    The survivors are ``peak_pass - scale * side_pass`` of ``peak - scale * side``.

    Parameters
    ----------
    peak_pass, peak
        Events in the peak's range: those that survive the cut, and all.
    side_pass, side
        The same in the sidebands.
    scale
        Width of the peak's range over that of the sidebands.

    Returns
    -------
    tuple of float
        Survival and its error in percent, from the Poisson errors of the events that
        survive and of those that do not; binomial if `scale` is 0.  The error of the
        cut is not in it.  NaN if no event of the peak is left.

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


def _cut(dep: Values, acceptance: float) -> float:
    """Quantile whose acceptance for new events is right on average, whatever their number."""
    return float(np.quantile(dep, 1 - acceptance, method="weibull"))


def _peak_survival(values: Values, cut: float, cuts: Values) -> PeakSurvival:
    finite = np.sort(values[np.isfinite(values)])
    n, missing = finite.size, len(values) - finite.size
    if not n:
        return PeakSurvival(float("nan"), float("nan"), 0, missing)
    passing = n - int(np.searchsorted(finite, cut))
    # spread of the posterior after a flat prior: not 0 if none or all survive
    p = (passing + 1) / (n + 2)
    counting = np.sqrt(p * (1 - p) / (n + 3))
    of_cut = (1 - np.searchsorted(finite, cuts) / n).std(ddof=1)
    return PeakSurvival(
        survival=100 * passing / n,
        std=float(100 * np.hypot(counting, of_cut)),
        n=n,
        missing=missing,
    )


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
