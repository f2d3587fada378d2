"""The A/E cut as used by experiments, and how well a simulation predicts its survival.

A is the maximum current of a pulse, E its energy.  Events of the double-escape peak
(DEP) deposit their energy at one site, like the decay that is searched for.  The cut is
placed where 90 % of them survive.  A pulse-shape simulation must predict
what fraction of other peaks survives it.

Prepared pulses are normalised, so that `parameters.current_amplitude` is A/E already.
The slight dependence of A/E on the energy, which experiments correct for before the cut,
is left in: its physics is the same in data and simulation, and the survival is no test of it.
Only the low side is cut; events near the contacts have a high A/E and need another cut.

Under a gamma line there is background, mostly Compton events of other lines, which the cut
removes more or less than the events of the line.  For the survival by ranges of energy it is
estimated from sidebands and subtracted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from pydantic import Field

from cpunet.pulses.parameters import Values
from cpunet.validation.bootstraps import resampled_quantiles
from cpunet.validation.comparisons import ByMethod, Missing, Number, Result, finite_values

Range = tuple[float, float]
Spread = tuple[float, float]  # a number and its error
ByPeak = Mapping[str, Mapping[str, Values]]

ACCEPTANCE = 0.9  # fraction of the DEP that survives
MIN_EVENTS = 20  # events of the DEP: two below the cut
DEP = "DEP"  # the peak that defines the cuts
BOOTSTRAPS = 300
SCALES = 100  # bootstraps of the position of the single-site peak
NULLS = 200  # draws of a difference without one


class SurvivalRow(Result):
    """Survival of one peak, by method and for the ``data``.

    Attributes
    ----------
    events, missing
        Number of events with and without a finite amplitude.
    cut, cut_std
        Of the DEP only, see `ae_survival`.
    survival, survival_std
        Of the other peaks, in percent.
    difference, difference_std, sigma
        Method minus data in percentage points, and the same divided by its error.
    of_fit
        Part of the error of the REN that is due to those of its fit.
    """

    events: dict[str, int] = Field(default_factory=dict)
    missing: dict[str, int] = Field(default_factory=dict)
    cut: ByMethod = Field(default_factory=dict)
    cut_std: ByMethod = Field(default_factory=dict)
    survival: ByMethod = Field(default_factory=dict)
    survival_std: ByMethod = Field(default_factory=dict)
    difference: ByMethod = Field(default_factory=dict)
    difference_std: ByMethod = Field(default_factory=dict)
    sigma: ByMethod = Field(default_factory=dict)
    of_fit: Number = None

    def compare(self, estimates: Mapping[str, Spread], spread: Mapping[str, float]) -> None:
        """Set differences from the data, with errors as given or those of both."""
        data, data_std = estimates["data"]
        self.survival = {method: survival for method, (survival, _) in estimates.items()}
        self.survival_std = {method: error for method, (_, error) in estimates.items()}
        others = {m: estimate for m, estimate in estimates.items() if m != "data"}
        off = {method: survival - data for method, (survival, _) in others.items()}
        std = {m: float(np.hypot(error, data_std)) for m, (_, error) in others.items()}
        # no bootstrap differs if no event is near the cut: that is no error
        std |= {m: error for m, error in spread.items() if error > 0}
        self.difference, self.difference_std = off, std
        self.sigma = {method: off[method] / std[method] for method in others}


class RangeSurvival(Result):
    """Survival of a gamma line or of a range of energies.

    Attributes
    ----------
    peak, peak_pass, sideband, sideband_pass
        Numbers of events in the range and in the sidebands, and of those that survive.
    scale
        Width of the range over that of the sidebands.
    undefined
        Events there without a finite amplitude, which are not counted.
    survival, survival_std
        Survival in percent, and its error with that of the cut.
    missing
        Reason why there is none.
    """

    peak: int = 0
    peak_pass: int = 0
    sideband: int = 0
    sideband_pass: int = 0
    scale: float = 0.0
    undefined: int = 0
    survival: float | None = None
    survival_std: float | None = None
    missing: str | None = None


def ae_survival(
    dep_ae: Values,
    others: Mapping[str, Values],
    *,
    bootstraps: int = BOOTSTRAPS,
    seed: int | np.random.Generator = 0,
) -> tuple[float, float, dict[str, Spread]]:
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
    cut, cut_std
        Lowest A/E that survives, in pulse heights per sample, and its error; NaN if fewer
        than 20 events of the DEP have an A/E.
    peaks
        Survival of the other peaks in percent and its error; NaN without events.  The error
        combines those of the number of survivors and of the cut in quadrature.

    Examples
    --------
    Of 99 equidistant values the cut is the 10th, and 90 of the 99 survive:

    >>> ae = np.arange(1.0, 100.0)
    >>> cut, _, peaks = ae_survival(ae, {"SEP": ae})
    >>> round(cut, 6), round(peaks["SEP"][0], 2)
    (10.0, 90.91)
    """
    dep = finite_values(dep_ae)
    if dep.size < MIN_EVENTS:
        return np.nan, np.nan, dict.fromkeys(others, (np.nan, np.nan))
    rng = np.random.default_rng(seed)
    # for this quantile the acceptance of new events is exact on average for any sample size
    cut = float(np.quantile(dep, 1 - ACCEPTANCE, method="weibull"))
    cuts = resampled_quantiles(dep, 1 - ACCEPTANCE, bootstraps, rng)
    peaks: dict[str, Spread] = {}
    for name, values in others.items():
        finite = np.sort(finite_values(values))
        n, peaks[name] = finite.size, (np.nan, np.nan)
        if n:
            passing = n - int(np.searchsorted(finite, cut))
            of_cut = (1 - np.searchsorted(finite, cuts) / n).std(ddof=1)
            error = float(100 * np.hypot(survival_error(passing, n), of_cut))
            peaks[name] = 100 * passing / n, error
    return cut, float(cuts.std(ddof=1)), peaks


def survival_table(
    ae: ByPeak, moved: Mapping[str, Values] = MappingProxyType({}), seed: int = 0
) -> dict[str, SurvivalRow] | Missing:
    """Survival of each peak in data and simulations, each after its own cut.

    Since each dataset has its own cut, a wrong scale of A/E alone makes no difference.

    Parameters
    ----------
    ae
        A/E by peak and method, the measured ones under ``"data"``.  Methods that lack a peak
        are left out.
    moved
        A/E of the REN by peak at both ends of each axis of the errors of its fit, shape
        ``(axes, 2, pulses)``.
    seed
        Seed of the bootstraps for the errors of the cuts.
    """
    if DEP not in ae:
        return Missing(missing=f"the data lack peak {DEP}; the A/E cut needs it")
    rng = np.random.default_rng(seed)
    methods = [
        m for m in next(iter(ae.values())) if all(m in of_peak for of_peak in ae.values())
    ]
    methods.sort(key=lambda method: method != "data")
    estimates = {
        method: ae_survival(
            ae[DEP][method],
            {name: of_peak[method] for name, of_peak in ae.items() if name != DEP},
            seed=rng,
        )
        for method in methods
    }
    table = {}
    for name, of_peak in ae.items():
        events = {m: int(np.isfinite(of_peak[m]).sum()) for m in methods}
        missing = {m: len(of_peak[m]) - events[m] for m in methods}
        row = table[name] = SurvivalRow(events=events, missing=missing)
        if name == DEP:
            row.cut = {m: cut for m, (cut, _, _) in estimates.items()}
            row.cut_std = {m: std for m, (_, std, _) in estimates.items()}
            continue
        survival = {m: s[2][name] for m, s in estimates.items()}
        spread = {
            m: null_spread((ae[DEP]["data"], ae[DEP][m]), (of_peak["data"], of_peak[m]), rng)
            for m in methods
            if m != "data"
        }
        row.of_fit = of_fit = 0.0
        ends = [moved[peak] for peak in (DEP, name) if peak in moved]
        if len(ends) == 2 and min(np.isfinite(v).sum(axis=2).min() for v in ends) >= MIN_EVENTS:
            quantile: Any = {"axis": 2, "keepdims": True, "method": "weibull"}
            cuts = np.nanquantile(ends[0], 1 - ACCEPTANCE, **quantile)
            percent = 100 * ((ends[1] >= cuts).sum(axis=2) / np.isfinite(ends[1]).sum(axis=2))
            of_fit = float(np.sqrt((0.25 * (percent[:, 0] - percent[:, 1]) ** 2).sum()))
            row.of_fit = of_fit
        if "ren" in survival:
            passed, error = survival["ren"]
            survival["ren"] = passed, float(np.hypot(error, of_fit))
            spread["ren"] = float(np.hypot(spread["ren"], of_fit))
        row.compare(survival, spread)
    return table


def peak_survival(
    amplitude: Values,
    energy_kev: Values,
    cut: float | None,
    peak: Range,
    sidebands: Sequence[Range] = (),
    cut_std: float | None = 0.0,
) -> RangeSurvival:
    """Survival of a gamma line after a low-A/E cut, with its background subtracted.

    Without sidebands, as for a range of the continuum, nothing is subtracted.

    Parameters
    ----------
    amplitude, energy_kev
        Current amplitude and energy in keV of each event, shape ``(n,)``.
    cut
        Lowest amplitude that survives, if any.
    peak
        Range of the line in keV: lower end (included) and upper end (excluded).
    sidebands
        Ranges in keV on both sides of the line that contain only background.
    cut_std
        Error of the cut.
    """
    inside = [
        np.concatenate(
            [np.empty(0), *(amplitude[(energy_kev >= a) & (energy_kev < b)] for a, b in of)]
        )
        for of in ([peak], sidebands)
    ]
    events = [finite_values(values) for values in inside]
    n, n_side = map(len, events)
    width = sum(high - low for low, high in sidebands)
    scale = (peak[1] - peak[0]) / width if width else 0.0
    # survivors of the cut and, for its error, of those that are lower and higher by it
    lowest, error = np.nan if cut is None else cut, cut_std or 0.0
    survivors = [
        [int((values >= lowest + by).sum()) for values in events] for by in (0.0, -error, error)
    ]
    (survival, std), (low, _), (high, _) = (
        sideband_survival(passing, n, side_pass, n_side, scale)
        for passing, side_pass in survivors
    )
    passing, side_pass = survivors[0]
    result = RangeSurvival(
        peak=n,
        peak_pass=passing,
        sideband=n_side,
        sideband_pass=side_pass,
        scale=scale,
        undefined=sum(map(len, inside)) - n - n_side,
    )
    span = f"from {peak[0]:g} to {peak[1]:g} keV"
    if not np.isfinite(lowest):
        result.missing = "there is no cut: too few events of the double-escape peak"
    elif not n:
        result.missing = f"no events {span}"
    elif not np.isfinite(survival):
        result.missing = f"the sidebands leave no events of {n} {span}"
    else:
        if not scale or not std:
            std = 100 * survival_error(passing, n)
        result.survival = survival
        result.survival_std = float(np.hypot(std, 0.5 * (low - high)))
    return result


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

    Examples
    --------
    >>> survival, std = sideband_survival(150, 400, 100, 200, scale=0.5)
    >>> round(survival, 2), round(std, 2)
    (33.33, 3.47)
    """
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


def dep_scales(dep_ae: Mapping[str, Values], seed: int = 0) -> dict[str, Spread]:
    """Position of the single-site peak of A/E in the double-escape peak, and its error.

    Parameters
    ----------
    dep_ae
        A/E of the events of the peak by method; values that are not finite are left out.
        Nothing is returned if a method has too few others.
    seed
        Seed of the bootstraps.
    """
    # half of SciPy, which those who only read scores need not wait for
    from cpunet.electronics.baseline_methods import most_frequent

    finite = {method: finite_values(values) for method, values in dep_ae.items()}
    if not all(values.size >= MIN_EVENTS for values in finite.values()):
        return {}
    scales = {}
    for method, values in finite.items():
        rng = np.random.default_rng(seed)
        drawn = [most_frequent(rng.choice(values, values.size)) for _ in range(SCALES)]
        scales[method] = most_frequent(values), float(np.std(drawn, ddof=1))
    return scales


def survivals(
    ae: ByPeak,
    moved: Mapping[str, Values],
    amplitudes: Mapping[str, Values],
    energy_kev: Mapping[str, Values],
    bands: Mapping[str, tuple[Range, Sequence[Range]]],
    seed: int,
) -> tuple[dict[str, SurvivalRow] | Missing, dict[str, dict[str, RangeSurvival]] | Missing]:
    """Survival of each peak, and of lines without their background and of continua.

    Parameters
    ----------
    ae, moved, seed
        See `survival_table`.
    amplitudes, energy_kev
        A/E and energies of all events by method.
    bands
        Range in keV and sidebands of lines and continua by name, see `peak_survival`.

    Returns
    -------
    table
        Result of `survival_table` with the background of lines subtracted, and with continua.
    ranges
        Survival by range and method.
    """
    table = survival_table(ae, moved, seed=seed)
    if isinstance(table, Missing):
        return table, Missing(missing=f"there is no A/E cut: {table.missing}")
    cuts, errors = table[DEP].cut, table[DEP].cut_std
    ranges = {
        name: {
            m: peak_survival(amplitudes[m], energy_kev[m], cut, span, sidebands, errors[m])
            for m, cut in cuts.items()
        }
        for name, (span, sidebands) in bands.items()
        if name != DEP
    }
    for name, methods in ranges.items():
        shares = {
            method: (of.survival, of.survival_std)
            for method, of in methods.items()
            if of.survival is not None and of.survival_std is not None
        }
        if "data" not in shares:
            continue
        spread = {}
        if name in table:
            # the subtraction adds the sampling of events below the line
            own = table[name].survival_std
            more = {
                m: max(e**2 - (own.get(m) or 0.0) ** 2, 0.0) for m, (_, e) in shares.items()
            }
            spread = {
                m: float(np.sqrt(std**2 + more[m] + more["data"]))
                for m, std in table[name].difference_std.items()
                if m in shares and std is not None
            }
        row = table[name] = SurvivalRow(
            events={method: of.peak for method, of in methods.items()},
            missing={method: of.undefined for method, of in methods.items()},
        )
        row.compare(shares, spread)
    return table, ranges


def null_spread(
    dep: tuple[Values, Values], other: tuple[Values, Values], rng: np.random.Generator
) -> float:
    """Standard deviation in percent of the difference of two survivals without a difference.

    Few events set a cut, below which those of other peaks are dense: errors of a survival grow
    with it, and two of them in quadrature are too large for most differences, and too small for
    some.  So the events of both sets together, in units of their medians, are divided anew, at
    random.

    Parameters
    ----------
    dep, other
        A/E of the double-escape peak and of the other one, of both sets.
    rng
        Random generator.
    """
    sets = [[finite_values(v) for v in both] for both in (dep, other)]
    if min(v.size for v in sets[0]) < MIN_EVENTS or not all(v.size for v in sets[1]):
        return float("nan")
    unit = [np.median(v) for v in sets[0]]
    pooled = [np.concatenate([v / u for v, u in zip(both, unit, strict=True)]) for both in sets]
    drawn = [[rng.permutation(v) for v in pooled] for _ in range(NULLS)]
    divided = (
        np.split(np.array(column), [both[0].size], axis=1)
        for column, both in zip(zip(*drawn, strict=True), sets, strict=True)
    )
    survival = []
    for single, some in zip(*divided, strict=True):
        cut = np.quantile(single, 1 - ACCEPTANCE, axis=1, keepdims=True, method="weibull")
        survival.append(100 * (some >= cut).mean(axis=1))
    return float((survival[1] - survival[0]).std(ddof=1))
