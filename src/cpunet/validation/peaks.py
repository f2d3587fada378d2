"""The pulses of one peak by method, and their scores.

What the errors of a fit do to translated pulses.

The parameters of a readout are as certain as their covariance says.  Some pulses are
translated again with the parameters at both ends of each axis of the error ellipsoid, with
the same noise: half of the difference along an axis is one standard deviation of whatever is
calculated of them.

Mean pulses in slices of rise time: where in the detector a translation is wrong.

Pulses of one slice come from the same regions of the detector and differ by their sites
and by noise.  Their mean, aligned at half maximum, is the slice's mean pulse.  Its standard
error is determined, so a difference of simulation and data can be distinguished from chance.

Pulses are ordered by their rise time from 1 to 90 % (``rise_01_90``), which starts with the
pulse and ends while it still rises.  The paper's drift time ends at the maximum, which on a
flat top depends on the noise and would smear the slices.

The slices are bounded by quantiles of the rise times of the *data*.  Each method is sliced
by its own rise times: a method with the wrong response has different events in a slice, which
counts against it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from cpunet.errors import CpunetError
from cpunet.processes import usable_cores
from cpunet.pulses.container import FloatArray, Pulses, Rows
from cpunet.pulses.parameters import PARAMETERS, Values, align_half_maximum, pulse_parameters
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.shape_parameters import A_OVER_E, all_parameters
from cpunet.pulses.two_sample import LARGEST, TwoSample, classifier_auc
from cpunet.training.chain_description import error_ends
from cpunet.training.run import Run
from cpunet.translation.backends import ResponseBackend
from cpunet.translation.translator import REN
from cpunet.validation.comparisons import Missing, compare
from cpunet.validation.methods import Translations, like_data, scores_of_squares
from cpunet.validation.metrics import PeakScores
from cpunet.validation.noise import baseline_spectra

BEFORE_NS, AFTER_NS = 1600.0, 2400.0  # of a mean pulse before and after half maximum
SLICES = 4
MIN_PULSES = 10  # minimum number of pulses of a distribution
MOVED = 300  # pulses of a peak, for which the errors of a fit are calculated
FIT_DRAWS = 8  # of the parameters, for the classifier

ByMethod = dict[str, dict[str, Values]]
Ends = Sequence[tuple[REN, REN]]


@dataclass(frozen=True, eq=False)
class MeanPulse:
    """The mean of pulses aligned at half maximum.

    Attributes
    ----------
    mean, error
        Mean and its standard error, shape ``(before + after,)``, in pulse heights; NaN where
        fewer than 2 pulses contribute.  Errors of neighbouring samples are correlated.
    n
        Number of pulses in the mean.
    """

    mean: Values
    error: Values
    n: int

    @classmethod
    def of(cls, aligned: FloatArray) -> Self:
        """Average pulses from `align_half_maximum`; those not aligned are left out.

        Sums are in float64: those of ten thousand float32 are off by a part of their error.
        """
        count = np.isfinite(aligned).sum(axis=0)
        mean = np.nansum(aligned, axis=0, dtype=float) / np.maximum(count, 1)
        squares = np.nansum((aligned - mean) ** 2, axis=0)
        error = np.sqrt(squares / np.maximum(count - 1, 1) / np.maximum(count, 1))
        mean, error = (np.where(count >= 2, values, np.nan) for values in (mean, error))
        return cls(mean, error, int(np.isfinite(aligned).any(axis=1).sum()))


def around_half(windows: FloatArray, dt_ns: float) -> FloatArray:
    """Pulses from `BEFORE_NS` before their half maximum to `AFTER_NS` after it."""
    before, after = round(BEFORE_NS / dt_ns), round(AFTER_NS / dt_ns)
    return align_half_maximum(windows, before, after)


def sliced(
    windows: Callable[[str], FloatArray],
    rise_time: Mapping[str, Values],
    dt_ns: float,
    slices: int = SLICES,
) -> tuple[Values, dict[str, list[MeanPulse]]]:
    """Mean pulses of each method, in the same slices of the rise time for all.

    Parameters
    ----------
    windows
        Prepared pulses of a method, shape ``(n, length)``.
    rise_time
        Their rise times in ns by method.  The edges divide the finite ones of the measured
        pulses, under ``"data"``, into equal numbers; the last slice includes its upper edge.
    dt_ns
        Sampling period in ns.
    slices
        Number of slices.

    Returns
    -------
    edges
        Edges of the slices in ns.
    means
        By method the mean of all pulses, and that of each slice.
    """
    measured = rise_time["data"][np.isfinite(rise_time["data"])]
    edges = np.quantile(measured, np.linspace(0, 1, slices + 1))
    means = {}
    for method, times in rise_time.items():
        aligned = around_half(windows(method), dt_ns)
        place = np.searchsorted(edges[1:-1], times, side="right")
        place[~((times >= edges[0]) & (times <= edges[-1]))] = -1  # also those that are NaN
        each = [MeanPulse.of(aligned[place == i]) for i in range(slices)]
        means[method] = [MeanPulse.of(aligned), *each]
    return edges, means


@dataclass(eq=False)
class PeakSets:
    """The pulses of one peak, as rows of the whole datasets.

    Parameters
    ----------
    name
        Name of a peak of the recipe, or a range in keV.
    translations
        Pulses of all methods.
    rows
        Rows of the pulses with noise, by method: the data, then from the simplest method to the
        truth; of translations those that can be prepared.
    values
        Pulse-shape parameters by method and name; empty if the peak is not scored.
    moved
        What the errors of the fit do to translated pulses, see `moved_values`.
    """

    name: str
    translations: Translations
    rows: dict[str, Rows]
    values: ByMethod = field(default_factory=dict)
    moved: dict[str, Values] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, translations: Translations) -> Self:
        """Select the pulses of a peak, of both sides and of the translations."""
        chosen = parse_selection(name, translations.ren.recipe.peaks)
        rows = {
            method: np.flatnonzero(chosen.select(translations.energy_kev[method]) & whole)
            for method, whole in translations.whole.items()
        }
        always = ("data", "raw", "ren")
        rows = {m: r for m, r in rows.items() if m in always or len(r) >= MIN_PULSES}
        return cls(name, translations, rows)

    def windows(self, method: str) -> FloatArray:
        """Pulses with noise of a method, copied from its whole dataset."""
        return self.translations.windows[method][self.rows[method]]

    def known_to_all(self) -> Rows:
        """Rows of the simulated events that all methods have without noise."""
        rows = self.rows["raw"]
        return rows[self.translations.comparable[rows]]

    def some(self, most: int) -> Pulses:
        """Simulated pulses of at most so many translated events, spread over all."""
        rows, of_all = self.rows["ren"], self.translations
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)]
        kev, windows = of_all.energy_kev["ren"][rows], of_all.windows["raw"][rows]
        return Pulses.of(windows, dt_ns=of_all.ren.dt_ns, energy_kev=kev)


def score_peak(
    peak: PeakSets,
    *,
    ends: Ends,
    seed: int,
    scales: Mapping[str, tuple[float, float]],
    decays_ns: Mapping[str, float],
) -> PeakScores:
    """Compare the pulses of a peak, method by method.

    Parameters
    ----------
    peak
        Pulses of the peak, whose values are set.
    ends
        See `fit_ends`.
    seed
        Seed of bootstraps and folds, and of the noise at all ends.
    scales
        A/E of the single-site peak in the double-escape peak and its error, by method.
    decays_ns
        Decay of all pulses of a method, for which LEGEND's parameters are corrected.
    """
    of_all, raw, data = peak.translations, peak.rows["raw"], peak.rows["data"]
    lost = {m: int((~whole[raw]).sum()) for m, whole in of_all.whole.items() if m != "data"}
    lost = {m: n for m, n in lost.items() if n}
    result = PeakScores(n_sim=len(raw), n_data=len(data), not_prepared=lost)
    sides = (("simulated", raw), ("measured", data))
    few = [f"{len(rows) or 'no'} {side}" for side, rows in sides if len(rows) < MIN_PULSES]
    if few:
        result.parameters = {}
        result.missing = f"{' and '.join(few)} pulses (at least {MIN_PULSES} are needed)"
        return result
    dt_ns, recipe = of_all.ren.dt_ns, of_all.ren.recipe
    values = peak.values = {
        method: all_parameters(
            Pulses.of(peak.windows(method), dt_ns=dt_ns),
            recipe.preparation,
            recipe.scores,
            amplitudes=of_all.amplitudes[method][rows],
            decay_ns=decays_ns.get(method),
        )
        for method, rows in peak.rows.items()
    }
    methods = [method for method in values if method != "data"]
    peak.moved = moved_values(peak, ends, seed)
    moved = {method: dict(peak.moved) if method == "ren" else {} for method in methods}
    for method, of_method in values.items() if scales else ():
        a_over_e = of_method[A_OVER_E] = of_method["current_amplitude"] / scales[method][0]
        if method != "data":
            # both ends of the axis of its error, that of both positions of the peak
            own, other = (scales[m][1] / scales[m][0] for m in ("data", method))
            error = np.hypot(own, other)
            both = np.stack([a_over_e * (1 + error), a_over_e * (1 - error)])
            moved[method][A_OVER_E] = both[np.newaxis]
    others = {method: values[method] for method in methods}
    compared = compare(values["data"], others, recipe.scores, seed, moved)
    result.parameters = {name: compared.pop(name) for name in PARAMETERS}
    result.further = compared

    def classified(method: str) -> TwoSample | Missing:
        both = ("data", method)
        of_data, of_method = ({n: values[m][n] for n in PARAMETERS} for m in both)
        features = of_data, of_method
        try:
            return classifier_auc(*map(peak.windows, both), seed=seed, features=features)
        except CpunetError as error:
            return Missing(missing=str(error))

    with ThreadPoolExecutor(usable_cores()) as pool:
        result.two_sample = dict(zip(methods, pool.map(classified, methods), strict=True))
    if ends and isinstance(tested := result.two_sample["ren"], TwoSample):
        result.two_sample["ren"] = replace(tested, of_fit=classifier_excess(peak, ends, seed))
    samples, before = recipe.preparation.baseline_samples, recipe.preparation.samples_before
    windows = {m: of_all.windows[m][rows, :samples] for m, rows in peak.rows.items()}
    begins = {m: before + of_method["t01"] / dt_ns for m, of_method in values.items()}
    result.noise = baseline_spectra(windows, begins, samples, dt_ns)
    if of_all.squares:
        rows = peak.known_to_all()
        result.paired = {m: scores_of_squares(of[rows]) for m, of in of_all.squares.items()}
    return result


def fit_ends(run: Run, ren: REN) -> Ends:
    """A translator at both ends of each axis of the errors; none of a network."""
    if run.fit is None or not isinstance(ren.backend, ResponseBackend):
        return []
    ends = []
    for pair in error_ends(ren.backend.network.response, run.fit.covariance, few=True):
        both = copy.copy(ren), copy.copy(ren)
        for moved, response in zip(both, pair, strict=True):
            moved.backend = copy.copy(ren.backend)
            moved.backend.network = network = copy.copy(ren.backend.network)
            network.response = response
        ends.append(both)
    return ends


def classifier_excess(peak: PeakSets, ends: Ends, seed: int) -> float:
    r"""How much the errors of a fit raise the AUC of the classifier, on average.

    Translations with parameters drawn from the covariance of the fit, which are the nominal
    ones :math:`x` and changes with normal numbers :math:`z_k`,

    .. math:: x' = x + \sum_k z_k \frac{x_{k+} - x_{k-}}{2}

    with those at both ends of each axis, differ from others as a measurement of the same
    detector does.  So the AUC between the two is by so much above that of translations with the
    same parameters.

    Parameters
    ----------
    peak
        Pulses of the peak.
    ends
        See `fit_ends`.
    seed
        Seed of the noise, the draws and the folds.
    """
    raw, nominal = peak.some(LARGEST), peak.translations.ren

    def translated(ren: REN, noise: int) -> FloatArray:
        return like_data(ren, raw, np.random.default_rng([seed, noise]))

    def chief(windows: FloatArray) -> dict[str, Values]:
        pulses, recipe = raw.with_waveforms(windows), nominal.recipe
        return pulse_parameters(pulses, recipe.preparation, recipe.scores)

    first, second = translated(nominal, 1), translated(nominal, 2)
    changes = [0.5 * (translated(one, 2) - translated(other, 2)) for one, other in ends]
    draws = np.random.default_rng(seed).normal(size=(FIT_DRAWS, len(ends)))
    of_first, aucs = chief(first), []
    for steps in (np.zeros(len(ends)), *draws):
        moved = second.copy()
        for step, change in zip(steps, changes, strict=True):
            moved += np.float32(step) * change
        both = (of_first, chief(moved))
        tested = classifier_auc(first, moved, seed=seed, features=both, same_events=True)
        aucs.append(tested.auc)
    return max(float(np.mean(aucs[1:])) - aucs[0], 0.0)


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
    raw, by_end = peak.some(MOVED), []
    if not ends or not len(raw):
        return {}
    for ren in (ren for pair in ends for ren in pair):
        rng, recipe = np.random.default_rng(seed), ren.recipe
        moved = ren.apply(raw.waveforms, energy_kev=raw.energy_kev, generator=rng)
        pulses = raw.with_waveforms(moved)
        by_end.append(all_parameters(pulses, recipe.preparation, recipe.scores))
    shape = len(ends), 2, len(raw)
    return {name: np.reshape([values[name] for values in by_end], shape) for name in by_end[0]}
