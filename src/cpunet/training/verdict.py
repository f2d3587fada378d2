"""Whether translated pulses are those of the data, with the power to see what a look sees.

Fitted functions say little of their own fit.  What counts here is every sample: the mean pulse
in units of its standard errors, chi-square of the slices by rank, and a classifier that is
tested on pulses outside its training.  Good is what passes all; else it says what is off, when
in the pulse, and what may be the cause.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cpunet.electronics.pile_up_tails import TailsInfo
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.loading import InfoPart
from cpunet.pulses.two_sample import MIN_PULSES, TwoSample, classifier_auc
from cpunet.training.aligned import Values
from cpunet.training.comparison import Comparison, Difference
from cpunet.training.pulse_sets import Sides

# Limits: chi-square per sample of the median slice, and per quantile of the amplitude; standard
# errors of the mean pulse; AUC, which must also be so many deviations from its null.
MAX_CHI_SQUARE, MAX_AMPLITUDE, MAX_Z, MAX_AUC, SURE = 1.3, 2.5, 5.0, 0.6, 3.0
CLEAR = 1 / 3  # of the way from what is expected to the limit of chi-square
WIDTH = 3.0  # of the bounded functions in robust standard deviations
LARGEST = 100.0  # standard errors that are stated
# Limits of the fraction of charge that arrives late; an overshoot makes it a few percent
# negative.
MAX_NEGATIVE, MAX_SLOW = -0.25, 0.5
DRIFT = {1: "drift-time scale", 2: "its change with time"}  # by number of terms
# Parts of a pulse by their end in ns from the half height, and likely causes.
PARTS = {
    "onset": (
        -240.0,
        "electronics cannot cause this: the physics simulated are not those of the detector, "
        "or it is another detector; try: cpunet check; cpunet calibrate finds temperature and "
        "impurities",
    ),
    "edge": (
        240.0,
        "a readout that is not linear, as of limited slew rate, or other physics; try: "
        "cpunet train --peak FEP,1000-1580; cpunet calibrate",
    ),
    "top": (
        1344.0,
        "charges that are trapped, or a readout that is not linear; try: cpunet train --peak "
        "FEP,1000-1580; cpunet calibrate",
    ),
    "tail": (
        np.inf,
        "in-trace pile-up, or pile-up tails too few to be sure of; try: cpunet info --quality "
        "tells of pile-up tails",
    ),
}
OTHER_MIXTURE = (
    "the distribution of the current amplitude differs: other energies or another mixture of "
    "events than simulated; try: cpunet check compares both sides"
)


class Verdict(InfoPart):
    """What the comparison of translated and measured pulses says.

    Parameters
    ----------
    chi_square, amplitude
        Per sample of the median slice, and per quantile of the current amplitude.
    z, z_ns
        Largest deviation of the mean pulse in its standard errors, and its time from the half
        height in ns.
    beyond_ns
        First and last time beyond `MAX_Z`; empty if none is.
    auc, auc_null, auc_error
        Of the classifier, the same of shuffled labels, and the standard deviation of that.
    off
        Largest deviation of the mean pulse by part, of those beyond the limit.
    pulses, left_out
        Simulated and measured pulses compared, and measured ones that are not, since another
        pulse is before them or on their tail.
    """

    chi_square: float
    amplitude: float
    z: float
    z_ns: float
    beyond_ns: list[float]
    auc: float = 0.5
    auc_null: float = 0.5
    auc_error: float = 0.0
    off: dict[str, float]
    pulses: list[int]
    left_out: int = 0

    @property
    def good(self) -> bool:
        """Whether nothing is off."""
        limits = self.chi_square <= MAX_CHI_SQUARE and self.amplitude <= MAX_AMPLITUDE
        alike = self.auc <= max(MAX_AUC, self.auc_null + SURE * self.auc_error)
        return limits and abs(self.z) <= MAX_Z and alike

    @property
    def clear(self) -> bool:
        """Whether nothing asks for more parameters."""
        near = self.chi_square - 1 < CLEAR * (MAX_CHI_SQUARE - 1)
        near &= self.amplitude - 1 < CLEAR * (MAX_AMPLITUDE - 1)
        return self.good and near and abs(self.z) < (1 - CLEAR) * MAX_Z

    @property
    def causes(self) -> list[str]:
        """What is off, why that may be, and what to try, worst first; a wrong onset leads."""
        causes = []
        for part in sorted(self.off, key=lambda part: (part != "onset", -self.off[part])):
            size = _size(self.off[part])
            causes.append(f"the {part} is off by {size}: {PARTS[part][1]}")
        if self.amplitude > MAX_AMPLITUDE:
            causes.append(OTHER_MIXTURE)
        if not causes and not self.good:
            causes.append("pulses differ from each other otherwise than simulated")
        return causes

    def __str__(self) -> str:
        size = _size(abs(self.z))
        mean = f"the mean pulse is within {size}"
        if self.beyond_ns:
            first, last = self.beyond_ns
            when = (
                f"from {first:.0f} to {last:.0f} ns" if first < last else f"at {first:.0f} ns"
            )
            mean = f"the mean pulse is off by {size}, {when} after the half height"
        return (
            f"{'good' if self.good else 'bad'}: {mean}, chi-square of its slices is "
            f"{self.chi_square:.2f} per sample, of the amplitude {self.amplitude:.2f}, a "
            f"classifier has an AUC of {self.auc:.2f}"
        )


class FitInfo(InfoPart):
    """Fit of a readout chain, or what was measured for a network.

    Parameters
    ----------
    checks
        What every sample says.
    verdict
        The same in a sentence, with the error of the current amplitude.
    chi_square, moments, steps
        Chi-square of all that is compared, how much that is, and the steps of all fits.
    parameters
        Of the response by name, with the unit at the end.
    errors, covariance
        Standard deviations of the fitted parameters by name, from the curvature of chi-square,
        and their covariance in this order.
    delay_ns
        Half rise of the step response.
    pulls
        Deviation of the mean pulse in its standard errors, by time from the half height.
    gains
        What held-out pulses say of each part that was tried.
    bands, in_no_band
        Energies compared, with the pulses of each side; pulses of energies that a side lacks.
    data_left_out, sim_left_out
        Number of pulses excluded: with a piled-up pulse, without a baseline, or collected late.
    amplitude_shift, amplitude_shift_error
        Relative change of the translated current amplitudes that would bring them closest to
        the data's.
    noise, tails
        Baselines and RMS of the noise; pile-up tails.
    """

    checks: Verdict | None = None
    verdict: str = ""
    chi_square: float | None = None
    moments: int | None = None
    steps: int = 0
    parameters: dict[str, float] = {}
    errors: dict[str, float] = {}
    covariance: list[list[float]] = []
    delay_ns: float = 0.0
    pulls: dict[str, float] = {}
    gains: dict[str, str] = {}
    bands: dict[str, list[int]] = {}
    in_no_band: dict[str, int] = {}
    data_left_out: int = 0
    sim_left_out: int = 0
    amplitude_shift: float | None = None
    amplitude_shift_error: float | None = None
    noise: dict[str, float] = {}
    tails: TailsInfo | None = None

    @property
    def causes(self) -> list[str]:
        """What is off, why that may be, and what to try."""
        return [] if self.checks is None else self.checks.causes

    @property
    def chi_square_per_moment(self) -> float | None:
        """Fit quality; well above 1 if more than the readout differs."""
        if self.chi_square is None or not self.moments:
            return None
        return self.chi_square / self.moments


def _size(z: float) -> str:
    few = f"{z:.1f} standard errors"
    return few if z < LARGEST else f"more than {LARGEST:.0f} standard errors"


def verdict(response: ElectronicsResponse, bands: Sequence[Sides]) -> tuple[Verdict, FitInfo]:
    """Compare translated and measured pulses of all bands; the worst of each counts."""
    chi_squares, quantiles, scores = list[float](), list[Difference](), list[TwoSample]()
    means, off, pulls = list[tuple[Values, Values]](), dict[str, float](), dict[str, float]()
    for sides in bands:
        here = Comparison(sides, response.transfer(sides.padded), WIDTH)
        z, time = here.mean_pulse(), sides.time_ns
        means.append((z, time))
        band, since = f"{sides.name}: " if len(bands) > 1 else "", -np.inf
        pulls |= {f"{band}{t:.0f} ns": of for t, of in zip(time, z.tolist(), strict=True)}
        for part, (until, _) in PARTS.items():
            inside = (time >= since) & (time < until)
            largest, since = float(np.abs(z[inside]).max(initial=0.0)), until
            if largest > MAX_Z:
                off[part] = max(round(largest, 1), off.get(part, 0.0))
        of_amplitude, *others = here.differences()
        quantiles.append(of_amplitude)
        chi_squares.append(float(np.median([d.chi_square for d in others if d.sliced])))
        both = sides.data, here.noisy[0]
        if min(map(len, both)) >= MIN_PULSES:
            more = [{"log": of.log_amplitude, "rise": of.rise} for of in both]
            pulses = (of.pulses for of in both)
            scores.append(classifier_auc(*pulses, seed=0, features=(more[0], more[1])))
    z, time = max(means, key=lambda mean: np.abs(mean[0]).max())
    worst, beyond, auc = int(np.abs(z).argmax()), time[np.abs(z) > MAX_Z].tolist(), {}
    if scores:
        distinct = max(scores, key=lambda score: score.auc - score.null_mean)
        auc = {"auc": distinct.auc, "auc_null": distinct.null_mean}
        auc["auc_error"] = distinct.null_std
    counts = {sides.name: [len(sides), len(sides.data)] for sides in bands}
    left_out = sum(sides.left_out for sides in bands)
    checks = Verdict(
        chi_square=max(chi_squares),
        amplitude=max(difference.chi_square for difference in quantiles),
        z=float(z[worst]),
        z_ns=float(time[worst]),
        beyond_ns=[beyond[0], beyond[-1]] if beyond else [],
        off=off,
        pulses=np.sum([*counts.values()], axis=0).tolist(),
        left_out=left_out,
        **auc,
    )
    shift, error = amplitude_shift(quantiles)
    return checks, FitInfo(
        checks=checks,
        pulls=pulls,
        bands=counts,
        data_left_out=left_out,
        sim_left_out=sum(sides.sim_left_out for sides in bands),
        amplitude_shift=shift,
        amplitude_shift_error=error,
    )


def amplitude_shift(quantiles: Sequence[Difference]) -> tuple[float, float]:
    """Relative shift that the translated current amplitudes need, and its error.

    It brings the quantiles of their logarithm closest to the data's.
    """
    weight = weighted = 0.0
    for difference in quantiles:
        inverse = np.linalg.inv(difference.covariance)
        weight += float(inverse.sum())
        weighted -= float(inverse.sum(axis=0) @ difference.values)
    return weighted / weight, weight**-0.5


def beyond(parameters: Mapping[str, float]) -> list[str]:
    """Properties of a fitted chain that no readout has, in words.

    Parameters
    ----------
    parameters
        Parameters from `ElectronicsResponse.describe`.

    Examples
    --------
    >>> beyond({"pole_1_ns": 40.0, "slow_100_ns": -0.5, "slow_400_ns": -0.2})
    ['70 % of the charge would arrive too early, which electronics cannot cause; see the fit']
    """
    if "deviation" in parameters:  # the parts of its chain are not what it consists of
        return []
    slow = sum(value for name, value in parameters.items() if name.startswith("slow_"))
    if MAX_NEGATIVE <= slow <= MAX_SLOW:
        return []
    how = "late, as of slower pulses than simulated"
    if slow < 0:
        how = "too early, which electronics cannot cause"
    return [f"{100 * abs(slow):.0f} % of the charge would arrive {how}; see the fit"]


def stretched(parameters: Mapping[str, float], gains: Mapping[str, str] = {}) -> list[str]:
    """Say in words that the simulated drift was stretched, if it was, and what that may mean.

    Parameters
    ----------
    parameters
        Parameters from `ElectronicsResponse.describe`.
    gains
        What held-out pulses say of each part that was tried.

    Examples
    --------
    >>> print(stretched({"drift_stretch": 0.052})[0])
    charges drift for 5.2 % longer than simulated, as in a warmer detector, at a lower bias or \
with other impurities: cpunet calibrate tells which
    """
    if (stretch := parameters.get("drift_stretch")) is None:
        return []
    change = parameters.get("drift_stretch_per_us", 0.0)
    late, early = (
        f"{100 * abs(of):.1f} % {'longer' if of > 0 else 'shorter'}"
        for of in (stretch, stretch + change)
    )
    size = f"charges drift for {early} than simulated"
    if change:
        size += f" in the last microsecond, {late} near its end"
    if (gain := gains.get(DRIFT[1], "").partition("; ")[2]) != "":
        size += f" ({gain})"
    how = ("warmer", "a lower") if stretch > 0 else ("colder", "a higher")
    cause = "{} detector, at {} bias".format(*how)
    return [f"{size}, as in a {cause} or with other impurities: cpunet calibrate tells which"]
