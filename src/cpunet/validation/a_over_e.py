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

from cpunet.pulses.parameters import Values, shorth
from cpunet.validation.comparisons import ByMethod, Missing, Number, Result, finite_values

Range = tuple[float, float]
ByPeak = Mapping[str, Mapping[str, Values]]

ACCEPTANCE = 0.9  # fraction of the DEP that survives
MIN_EVENTS = 20  # events of the DEP: two below the cut
DEP = "DEP"  # the peak that defines the cuts
BOOTSTRAPS = 300
SCALES = 100  # bootstraps of the position of the single-site peak
NULLS = 200  # draws of a difference without one
NONE = np.empty(0)


class SurvivalRow(Result):
    """Survival of one peak, by method and for the ``data``.

    Attributes
    ----------
    events, missing
        Number of events with and without a finite amplitude.
    cut, cut_std
        Of the DEP only, see `dep_cuts`.
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


def dep_cuts(dep_ae: Values, rng: np.random.Generator, bootstraps: int = BOOTSTRAPS) -> Values:
    """The A/E that 90 % of the double-escape peak reach, and that of bootstraps of its events.

    The acceptance is exact on average for *new* events of the same kind, however few events
    set the cut.

    Parameters
    ----------
    dep_ae
        A/E of the events of the double-escape peak; values that are not finite are left out.
    rng, bootstraps
        Random generator and number of the bootstraps.

    Returns
    -------
    numpy.ndarray
        In pulse heights per sample, shape ``(1 + bootstraps,)``; NaN if fewer than 20 events
        have an A/E.
    """
    dep = finite_values(dep_ae)
    if dep.size < MIN_EVENTS:
        return np.full(1 + bootstraps, np.nan)
    samples = np.vstack([dep, rng.choice(dep, (bootstraps, dep.size))])
    return np.asarray(np.quantile(samples, 1 - ACCEPTANCE, axis=1, method="weibull"))


def range_survival(
    events: Values, cuts: Values, background: Values = NONE, scale: float = 0.0
) -> RangeSurvival:
    r"""Survival of events after a low-A/E cut, with their background subtracted.

    .. math:: S = \frac{p - \alpha \, s}{P - \alpha \, S_b}, \qquad
        \sigma_S^2 = \frac{(1 - S)^2 (p + \alpha^2 s) + S^2 (f + \alpha^2 f_b)}
        {(P - \alpha \, S_b)^2} + \sigma_c^2

    with :math:`p` of :math:`P` events surviving in the range, :math:`s` of :math:`S_b` in the
    sidebands, :math:`f = P - p`, :math:`f_b = S_b - s`, the `scale` :math:`\alpha`, and the
    spread :math:`\sigma_c` of :math:`S` over bootstraps of the cut.  Without sidebands the
    first term is the variance of the posterior with a flat prior, which is not 0 if none or all
    of the events survive.

    Parameters
    ----------
    events, background
        A/E of the events of the range and of the sidebands.
    cuts
        Lowest A/E that survives, and that of bootstraps, see `dep_cuts`.
    scale
        Width of the range divided by that of the sidebands.

    Examples
    --------
    Of 99 equidistant values the cut is the 10th, and 90 of the 99 survive:

    >>> ae = np.arange(1.0, 100.0)
    >>> cuts = dep_cuts(ae, np.random.default_rng(1))
    >>> round(float(cuts[0]), 6), round(range_survival(ae, cuts).survival, 2)
    (10.0, 90.91)
    """
    inside, sides = (np.sort(finite_values(values)) for values in (events, background))
    n, n_side = len(inside), len(sides)
    passing, side_pass = (len(v) - np.searchsorted(v, cuts) for v in (inside, sides))
    p, s, total = int(passing[0]), int(side_pass[0]), n - scale * n_side
    undefined = len(events) + len(background) - n - n_side
    result = RangeSurvival(
        peak=n, peak_pass=p, sideband=n_side, sideband_pass=s, scale=scale, undefined=undefined
    )
    if not np.isfinite(cuts[0]):
        result.missing = "there is no cut: too few events of the double-escape peak"
    elif not n:
        result.missing = "no events"
    elif total <= 0:
        result.missing = f"the sidebands leave no events of {n}"
    else:
        shares = (passing - scale * side_pass) / total
        share = float(shares[0])
        # events that pass and that fail are independent; the sums of both are not
        lost = n - p + scale**2 * (n_side - s)
        variance = (1 - share) ** 2 * (p + scale**2 * s) + share**2 * lost
        variance /= total**2
        if not scale or not variance:
            likely = (p + 1) / (n + 2)
            variance = likely * (1 - likely) / (n + 3)
        result.survival = 100 * share
        result.survival_std = float(100 * np.sqrt(variance + shares[1:].var(ddof=1)))
    return result


def survivals(
    ae: ByPeak,
    amplitudes: Mapping[str, Values],
    energy_kev: Mapping[str, Values],
    bands: Mapping[str, tuple[Range, Sequence[Range]]],
    moved: Mapping[str, Values] = MappingProxyType({}),
    seed: int = 0,
) -> tuple[dict[str, SurvivalRow] | Missing, dict[str, dict[str, RangeSurvival]] | Missing]:
    """Survival of peaks, lines and continua in data and simulations, each after its own cut.

    Since each dataset has its own cut, a wrong scale of A/E alone makes no difference.

    Parameters
    ----------
    ae
        A/E by peak and method, the measured ones under ``"data"``.  Methods that lack a peak
        are left out.
    amplitudes, energy_kev
        A/E and energies in keV of all events by method.
    bands
        Range and sidebands of lines and continua by name; other peaks have no background.
    moved
        A/E of the REN by peak at both ends of each axis of the errors of its fit, shape
        ``(axes, 2, pulses)``.
    seed
        Seed of the bootstraps and of `null_spread`.

    Returns
    -------
    table
        Survival by peak; of the double-escape peak the cuts.
    ranges
        Numbers of events of lines and continua by name and method.
    """
    if DEP not in ae:
        reason = f"the data lack peak {DEP}; the A/E cut needs it"
        return Missing(missing=reason), Missing(missing=f"there is no A/E cut: {reason}")
    rng = np.random.default_rng(seed)
    single = {m: v for m, v in ae[DEP].items() if all(m in of for of in ae.values())}
    cuts = {m: dep_cuts(values, rng) for m, values in single.items()}
    table = {
        DEP: SurvivalRow(
            events={m: np.isfinite(v).sum() for m, v in single.items()},
            missing={m: (~np.isfinite(v)).sum() for m, v in single.items()},
            cut={m: of[0] for m, of in cuts.items()},
            cut_std={m: of[1:].std(ddof=1) for m, of in cuts.items()},
        )
    }
    ranges: dict[str, dict[str, RangeSurvival]] = {}
    for name in (name for name in dict.fromkeys([*ae, *bands]) if name != DEP):
        results = {}
        for m in single:
            if name in bands:
                span, sidebands = bands[name]
                inside, *sides = (
                    amplitudes[m][(energy_kev[m] >= low) & (energy_kev[m] < high)]
                    for low, high in (span, *sidebands)
                )
                width = sum(high - low for low, high in sidebands)
                scale = (span[1] - span[0]) / width if width else 0.0
                background = np.concatenate([NONE, *sides])
                results[m] = range_survival(inside, cuts[m], background, scale)
            else:
                results[m] = range_survival(ae[name][m], cuts[m])
        ends, of_fit = [moved[peak] for peak in (DEP, name) if peak in moved], 0.0
        if len(ends) == 2 and min(np.isfinite(v).sum(axis=2).min() for v in ends) >= MIN_EVENTS:
            quantile: Any = {"axis": 2, "keepdims": True, "method": "weibull"}
            lowest = np.nanquantile(ends[0], 1 - ACCEPTANCE, **quantile)
            share = (ends[1] >= lowest).sum(axis=2) / np.isfinite(ends[1]).sum(axis=2)
            of_fit = float(50 * np.linalg.norm(share[:, 0] - share[:, 1]))
        row = table[name] = SurvivalRow(
            events={m: of.peak for m, of in results.items()},
            missing={m: of.undefined for m, of in results.items()},
            of_fit=of_fit,
        )
        # NaN without a survival
        estimates = {
            m: np.array([of.survival, of.survival_std], float) for m, of in results.items()
        }
        if "ren" in estimates:
            estimates["ren"][1] = np.hypot(estimates["ren"][1], of_fit)
        row.survival = {m: share for m, (share, _) in estimates.items()}
        row.survival_std = {m: error for m, (_, error) in estimates.items()}
        others = [m for m in results if m != "data"]
        off = {m: estimates[m][0] - estimates["data"][0] for m in others}
        spread = {m: np.hypot(estimates[m][1], estimates["data"][1]) for m in others}
        for m in others if name in ae else ():
            dep, other = ((of_peak["data"], of_peak[m]) for of_peak in (ae[DEP], ae[name]))
            null = null_spread(dep, other, rng)
            if null > 0:  # no division differs if no event is near the cut: that is no error
                # the subtraction adds the sampling of events below the line
                plain = [range_survival(ae[name][x], cuts[x]).survival_std for x in ("data", m)]
                whole = [results[x].survival_std for x in ("data", m)]
                more = np.square(np.array(whole, float)) - np.square(np.array(plain, float))
                of_ren = of_fit if m == "ren" else 0.0
                spread[m] = np.sqrt(null**2 + of_ren**2 + np.maximum(more, 0.0).sum())
        row.difference, row.difference_std = off, spread
        row.sigma = {m: off[m] / spread[m] for m in others}
        if name in bands:
            ranges[name] = results
    return table, ranges


def dep_scales(dep_ae: Mapping[str, Values], seed: int = 0) -> dict[str, tuple[float, float]]:
    """Position of the single-site peak of A/E in the double-escape peak, and its error.

    Parameters
    ----------
    dep_ae
        A/E of the events of the peak by method; values that are not finite are left out.
        Nothing is returned if a method has too few others.
    seed
        Seed of the bootstraps.
    """
    finite = {method: finite_values(values) for method, values in dep_ae.items()}
    if not all(values.size >= MIN_EVENTS for values in finite.values()):
        return {}
    scales = {}
    for method, values in finite.items():
        rng = np.random.default_rng(seed)
        drawn = [shorth(rng.choice(values, values.size)) for _ in range(SCALES)]
        scales[method] = shorth(values), float(np.std(drawn, ddof=1))
    return scales


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
    divided = []
    for both in sets:
        pooled = np.concatenate([v / u for v, u in zip(both, unit, strict=True)])
        drawn = rng.permuted(np.tile(pooled, (NULLS, 1)), axis=1)
        divided.append(np.split(drawn, [both[0].size], axis=1))
    survival = []
    for single, some in zip(*divided, strict=True):
        cut = np.quantile(single, 1 - ACCEPTANCE, axis=1, keepdims=True, method="weibull")
        survival.append(100 * (some >= cut).mean(axis=1))
    return float((survival[1] - survival[0]).std(ddof=1))
