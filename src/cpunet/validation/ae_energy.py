"""A/E against energy: position and width of the single-site peak, and fits to both.

In each energy range the single-site events form a peak, with a tail of multi-site events below.
Its position decreases with energy, since larger charge clouds are collected more slowly.  Its
width decreases too, since noise matters less.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.special import expit, log_ndtr, ndtr

from cpunet.pulses.container import shortest
from cpunet.pulses.parameters import Values
from cpunet.validation.a_over_e import DEP, Range
from cpunet.validation.comparisons import Result, finite_values

LOWEST_KEV, HIGHEST_KEV, WIDTH_KEV = 900.0, 2700.0, 50.0
BESIDE_KEV = 8.0  # margin of a line that is left out of the continuum
MIN_EVENTS = 60  # minimum number of events in a fit
BELOW, ABOVE = 6.0, 4.0  # range of the fit in widths of the peak
FITTED = ("energy_kev", "mean", "mean_error", "sigma", "sigma_error")
REFERENCE_KEV = 1592.5  # where A/E is 1: the double-escape peak


@dataclass(frozen=True)
class SiteFit:
    """The peak of single-site events in one range of energy.

    Attributes
    ----------
    low_kev, high_kev, energy_kev
        Ends of the range, and mean energy of its events.
    mean, mean_error, sigma, sigma_error
        Mean and sigma of the Gaussian with their errors, in units of A/E.
    n
        Number of fitted events.
    """

    low_kev: float
    high_kev: float
    energy_kev: float
    mean: float
    mean_error: float
    sigma: float
    sigma_error: float
    n: int


@dataclass(frozen=True)
class MeanLine:
    """Straight line ``a E + b`` through the means, which is 1 at 1592.5 keV.

    Attributes
    ----------
    a, a_error, b
        Slope per keV with its error, and constant.
    per_mev_percent, per_mev_error_percent
        The slope in percent per MeV.
    chi_square, degrees
        Of the fit, and its degrees of freedom.
    """

    a: float
    b: float
    a_error: float
    per_mev_percent: float
    per_mev_error_percent: float
    chi_square: float
    degrees: int


@dataclass(frozen=True)
class WidthLaw:
    """Relative width ``sqrt(a + (b/E)**c)``, and its value at 1592.5 keV in percent."""

    a: float
    b: float
    c: float
    at_reference_percent: float

    def of(self, energy_kev: Values) -> Values:
        """Relative width at some energies."""
        return np.asarray(np.sqrt(self.a + (self.b / energy_kev) ** self.c))


@dataclass(frozen=True)
class Course:
    """A/E of one method against energy.

    Attributes
    ----------
    points
        Fit of each range of energy.
    scale, scale_error
        A/E at 1592.5 keV and its error.
    mean, resolution
        Fits to means and widths, both relative to `scale`.
    """

    points: list[SiteFit]
    scale: float
    scale_error: float
    mean: MeanLine
    resolution: WidthLaw


class AgainstEnergy(Result):
    """A/E against energy.

    Attributes
    ----------
    multi_site
        Whether lines with mostly multi-site events were fitted too.
    methods
        Points and fits of each method.
    missing
        Reason why there is nothing.
    """

    multi_site: bool | None = None
    methods: dict[str, Course] = Field(default_factory=dict)
    missing: str | None = None


def against_energy(
    amplitude: Mapping[str, Values],
    energy_kev: Mapping[str, Values],
    lines_kev: Mapping[str, Range],
) -> AgainstEnergy:
    """Position and width of the single-site peak against energy, by method, with fits to both.

    Parameters
    ----------
    amplitude, energy_kev
        A/E and energy of each event, by method, ``data`` among them.
    lines_kev
        Range of each gamma line.  Events within 8 keV of one are left out of the continuum.
        If fewer than three ranges can be fitted for all methods, the other lines are fitted
        too, although few of their events have one site.
    """
    lines = list(lines_kev.values())
    lows = np.arange(LOWEST_KEV, HIGHEST_KEV, WIDTH_KEV).tolist()
    single_site = [span for name, span in lines_kev.items() if name == DEP]
    single_site += [(low, low + WIDTH_KEV) for low in lows]
    others = [span for span in lines if span not in single_site]
    fits: dict[str, dict[Range, SiteFit]] = {method: {} for method in amplitude}
    about: dict[str, tuple[float, float]] = {}  # the first range guides the others
    common: set[Range] = set()
    for bands in (single_site, others):
        for method, values in amplitude.items():
            kev, off_lines = energy_kev[method], np.ones(len(values), bool)
            for low, high in lines:
                off_lines &= (kev < low - BESIDE_KEV) | (kev >= high + BESIDE_KEV)
            for low, high in bands:
                inside = (kev >= low) & (kev < high)
                if (low, high) not in lines:
                    inside &= off_lines
                fitted = site_fit(values[inside], about.get(method))
                if fitted is not None:
                    about.setdefault(method, (fitted[0], fitted[2]))
                    centre = float(kev[inside].mean())
                    fits[method][low, high] = SiteFit(low, high, centre, *fitted)
        common = set.intersection(*map(set, fits.values()))
        if len(common) >= 3:
            break
    else:  # a line through two points has no chi-square
        return AgainstEnergy(
            missing=f"A/E can be fitted in {len(common)} ranges of energy only; "
            "it takes three that both sides have: give events of more energies"
        )
    methods = {
        method: _course(sorted((of[span] for span in common), key=lambda p: p.energy_kev))
        for method, of in fits.items()
    }
    return AgainstEnergy(multi_site=bands is others, methods=methods)


def site_fit(
    amplitude: Values, about: tuple[float, float] | None = None
) -> tuple[float, float, float, float, int] | None:
    """Gaussian with an exponential tail below, fitted to the peak of A/E by likelihood.

    Parameters
    ----------
    amplitude
        A/E of all events of a range.
    about
        Position and width of the single-site peak at another energy.  It is needed where most
        events have several sites, since the highest peak is then not that of single sites.  If
        None, both are estimated from the highest peak.

    Returns
    -------
    tuple
        Mean and its error, sigma and its error, and the number of fitted events; None if
        there are too few events or no peak.
    """
    from iminuit import Minuit

    values = np.sort(finite_values(amplitude))
    if about is None:
        if len(values) < MIN_EVENTS:
            return None
        # the middle of the shortest interval with a fifth of the values
        n = max(20, len(values) // 5)
        centre = float(np.median(shortest(values, n)))
        above = values[values > centre] - centre
        about = centre, float(np.quantile(above, 0.68)) if len(above) >= 10 else 0.0
    centre, width = about
    x = (values - centre) / width if width else np.empty(0)
    x = x[(x > -BELOW) & (x < ABOVE)]
    if len(x) < MIN_EVENTS:
        return None

    def negative_log_likelihood(parameters: Values) -> float:
        mean, log_sigma, share, log_tail = parameters
        log_sigma, log_tail = np.clip(log_sigma, -3, 3), np.clip(log_tail, -2, 4)
        sigma, p, tail = np.exp(log_sigma), expit(share), np.exp(log_tail)
        shift = sigma / tail

        def tailed(u: Values) -> Values:
            return np.asarray(np.exp(0.5 * shift**2 + u * shift + log_ndtr(-u - shift)))

        u, ends = (x - mean) / sigma, (np.array([ABOVE, -BELOW]) - mean) / sigma
        above, below = ndtr(ends) + p * tailed(ends)
        gauss = np.exp(-0.5 * u**2) / (sigma * np.sqrt(2 * np.pi))
        density = ((1 - p) * gauss + p * tailed(u) / tail) / max(above - below, 1e-12)
        # weak priors: a tail of a few widths, a tail fraction of about a third, and a width
        # near the given one, since otherwise a chance cluster of a few events can be taken
        # for the peak
        prior = 0.5 * (((share + 0.5) / 2) ** 2 + ((log_tail - 1) / 1.5) ** 2)
        prior += 0.5 * (log_sigma / 0.4) ** 2
        return float(-np.log(np.maximum(density, 1e-300)).sum() + prior)

    fit = Minuit(negative_log_likelihood, np.array([0.0, 0.0, -0.5, 1.0]))
    fit.errordef = Minuit.LIKELIHOOD
    fit.errors = (0.1, 0.1, 0.5, 0.5)
    fit.migrad().hesse()
    if not fit.valid:
        return None
    (mean, log_sigma, *_), (error, log_error, *_) = fit.values, fit.errors
    sigma = width * float(np.exp(log_sigma))
    return centre + width * mean, width * error, sigma, sigma * log_error, len(x)


def _course(points: list[SiteFit]) -> Course:
    """Fit a straight line to the means, 1 at the reference energy, and a law to the widths."""
    from scipy.optimize import nnls

    energy, mean, error, sigma, sigma_error = columns(points)
    design = np.stack([energy - REFERENCE_KEV, np.ones(len(energy))], axis=1) / error[:, None]
    slope, scale = np.linalg.lstsq(design, mean / error, rcond=None)[0]
    covariance = np.linalg.inv(design.T @ design) / scale**2
    chi_square = float(np.sum(((mean - scale - slope * (energy - REFERENCE_KEV)) / error) ** 2))
    a, (a_error, scale_error) = float(slope / scale), np.sqrt(np.diag(covariance)).tolist()
    of_line = (a, 1 - a * REFERENCE_KEV, a_error, 1e5 * a, 1e5 * a_error, chi_square)
    line = MeanLine(*of_line, degrees=len(points) - 2)
    # a and b of sqrt(a + (b/E)^2), neither below 0, from the squared widths
    terms = np.stack([np.ones(len(energy)), 1e6 / energy**2], axis=1)
    relative, spread = sigma / mean, sigma_error / mean
    squares = relative**2
    for _ in range(3):
        # errors are scaled to the fitted widths; otherwise widths that fluctuate low weigh most
        weight = relative / (2 * squares * spread)
        constant, b2 = nnls(terms * weight[:, None], relative**2 * weight)[0]
        squares = terms @ np.array([constant, b2])
    at_reference = float(100 * np.sqrt(constant + b2 * 1e6 / REFERENCE_KEV**2))
    law = WidthLaw(float(constant), float(1e3 * np.sqrt(b2)), 2.0, at_reference)
    return Course(points, float(scale), float(scale) * scale_error, line, law)


def columns(points: Sequence[SiteFit]) -> Values:
    """Fitted values of the points, as rows of an array."""
    return np.array([[getattr(point, name) for point in points] for name in FITTED])
