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
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.processes import usable_cores
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import PARAMETERS, Values, align_half_maximum
from cpunet.pulses.peaks import EnergySelection
from cpunet.pulses.shape_parameters import A_OVER_E, all_parameters
from cpunet.pulses.two_sample import TwoSample, classifier_auc
from cpunet.recipes.schema import Recipe
from cpunet.training.closed_forms import error_ends
from cpunet.training.run import Run
from cpunet.translation.backends import ResponseBackend
from cpunet.translation.translator import REN
from cpunet.validation.comparisons import Missing, compare
from cpunet.validation.methods import Translations, scores_of_squares
from cpunet.validation.metrics import PairedScores, PeakScores
from cpunet.validation.noise import baseline_spectra

BEFORE_NS, AFTER_NS = 1600.0, 2400.0  # of a mean pulse before and after half maximum
SLICES = 4


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


@dataclass(frozen=True, eq=False)
class Slices:
    """The mean pulses of a dataset by rise time.

    Attributes
    ----------
    whole
        Mean of all pulses.
    pulses, edges
        Mean pulse of each slice, and the edges of the slices in ns.
    """

    whole: MeanPulse
    pulses: tuple[MeanPulse, ...]
    edges: Values


def around_half(windows: FloatArray, dt_ns: float) -> FloatArray:
    """Pulses from `BEFORE_NS` before their half maximum to `AFTER_NS` after it."""
    before, after = round(BEFORE_NS / dt_ns), round(AFTER_NS / dt_ns)
    return align_half_maximum(windows, before, after)


def sliced(
    windows: Callable[[str], FloatArray],
    rise_time: Mapping[str, Values],
    dt_ns: float,
    slices: int = SLICES,
) -> dict[str, Slices]:
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
    """
    measured = rise_time["data"][np.isfinite(rise_time["data"])]
    edges = np.quantile(measured, np.linspace(0, 1, slices + 1))
    means = {}
    for method, times in rise_time.items():
        aligned = around_half(windows(method), dt_ns)
        place = np.searchsorted(edges[1:-1], times, side="right")
        place[~((times >= edges[0]) & (times <= edges[-1]))] = -1  # also those that are NaN
        pulses = tuple(MeanPulse.of(aligned[place == i]) for i in range(slices))
        means[method] = Slices(MeanPulse.of(aligned), pulses, edges)
    return means


MIN_PULSES = 10  # minimum number of pulses of a distribution

Rows = npt.NDArray[np.int64]
ByMethod = dict[str, dict[str, Values]]


@dataclass(frozen=True, eq=False)
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
    """

    name: str
    translations: Translations
    rows: dict[str, Rows]

    @classmethod
    def of(cls, name: str, chosen: EnergySelection, translations: Translations) -> Self:
        """Select the pulses of a peak, of both sides and of the translations."""
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

    def paired_scores(self) -> dict[str, PairedScores]:
        """Paired scores by method; none if the truth is unknown."""
        rows, squares = self.known_to_all(), self.translations.squares
        return {method: scores_of_squares(of[rows]) for method, of in squares.items()}


def score_peak(
    peak: PeakSets,
    moved: Mapping[str, Values],
    *,
    recipe: Recipe,
    seed: int,
    scales: Mapping[str, tuple[float, float]] = MappingProxyType({}),
    decays_ns: Mapping[str, float] = MappingProxyType({}),
) -> tuple[ByMethod, PeakScores]:
    """Compare the pulses of a peak, method by method.

    Parameters
    ----------
    peak
        Pulses of the peak.
    moved
        What the errors of the fit do to translated pulses, see
        `cpunet.validation.peaks.moved_values`.
    recipe
        Recipe of the run.
    seed
        Seed of bootstraps and folds.
    scales
        A/E of the single-site peak in the double-escape peak and its error, by method.
    decays_ns
        Decay of all pulses of a method, for which LEGEND's parameters are corrected.

    Returns
    -------
    values
        Pulse-shape parameters by method and name.  Empty if the peak is not scored.
    scores
        Scores of the peak.
    """
    raw, data = peak.rows["raw"], peak.rows["data"]
    lost = {
        method: int((~whole[raw]).sum())
        for method, whole in peak.translations.whole.items()
        if method != "data"
    }
    result = PeakScores(
        n_sim=len(raw), n_data=len(data), not_prepared={m: n for m, n in lost.items() if n}
    )
    sides = (("simulated", raw), ("measured", data))
    few = [f"{len(rows) or 'no'} {side}" for side, rows in sides if len(rows) < MIN_PULSES]
    if few:
        result.parameters = {}
        result.missing = f"{' and '.join(few)} pulses (at least {MIN_PULSES} are needed)"
        return {}, result
    dt_ns, samples = peak.translations.ren.dt_ns, recipe.preparation.baseline_samples
    values = {
        method: all_parameters(
            Pulses.of(peak.windows(method), dt_ns=dt_ns),
            recipe.preparation,
            recipe.scores,
            amplitudes=peak.translations.amplitudes[method][rows],
            decay_ns=decays_ns.get(method),
        )
        for method, rows in peak.rows.items()
    }
    ends = {"ren": dict(moved)} | {m: {} for m in values if m not in ("data", "ren")}
    for method, of_method in values.items() if scales else ():
        a_over_e = of_method[A_OVER_E] = of_method["current_amplitude"] / scales[method][0]
        if method != "data":
            # both ends of the axis of its error, that of both positions of the peak
            own, other = (scales[m][1] / scales[m][0] for m in ("data", method))
            error = np.hypot(own, other)
            moved_by = np.stack([a_over_e * (1 + error), a_over_e * (1 - error)])
            ends[method][A_OVER_E] = moved_by[np.newaxis]
    others = {m: of_method for m, of_method in values.items() if m != "data"}
    compared = compare(values["data"], others, recipe.scores, seed, ends)
    result.parameters = {name: compared.pop(name) for name in PARAMETERS}
    result.further = compared
    result.two_sample = classifier_tests(peak, values, seed)
    result.noise = baseline_spectra(
        {method: peak.windows(method)[:, :samples].copy() for method in values},
        {m: recipe.preparation.samples_before + of["t01"] / dt_ns for m, of in values.items()},
        samples,
        dt_ns,
    )
    if paired := peak.paired_scores():
        result.paired = paired
    return values, result


def classifier_tests(
    peak: PeakSets, values: ByMethod, seed: int
) -> dict[str, TwoSample | Missing]:
    """Classifier test between each method and the data, for one peak.

    Parameters
    ----------
    peak
        Pulses of the peak.
    values
        Pulse-shape parameters of those with noise, by method.
    seed
        Seed of the folds.
    """
    data = peak.windows("data")
    chief = {
        m: {name: of_method[name] for name in PARAMETERS} for m, of_method in values.items()
    }

    def tested(method: str) -> TwoSample | Missing:
        features = chief["data"], chief[method]
        try:
            return classifier_auc(data, peak.windows(method), seed=seed, features=features)
        except CpunetError as error:
            return Missing(missing=str(error))

    methods = list(values)[1:]
    with ThreadPoolExecutor(usable_cores()) as pool:
        return dict(zip(methods, pool.map(tested, methods), strict=True))


PULSES = 300  # of a peak, for which an effect is calculated

Ends = Sequence[tuple[REN, REN]]


@dataclass(frozen=True, eq=False)
class _DrawnOnce(BaselineNoise):
    """Noise that is drawn once for the same energies: all ends of an error have one seed."""

    drawn: dict[bytes, tuple[FloatArray, Mapping[str, Any]]] = field(default_factory=dict)

    def draw(self, energy_kev: Values, length: int, rng: np.random.Generator) -> FloatArray:
        key = energy_kev.tobytes()
        if key not in self.drawn:
            noise = super().draw(energy_kev, length, rng)
            noise.flags.writeable = False
            self.drawn[key] = noise, rng.bit_generator.state
        noise, rng.bit_generator.state = self.drawn[key]
        return noise


def fit_ends(run: Run, ren: REN) -> Ends:
    """A translator at both ends of each axis of the errors; none of a network."""
    backend = copy.copy(ren.backend)
    if run.fit is None or not isinstance(backend, ResponseBackend):
        return []
    if backend.noise is not None:
        backend.noise = _DrawnOnce(**vars(backend.noise))

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
