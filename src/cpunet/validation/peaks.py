"""The pulses of one peak by method, and their scores."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.processes import usable_cores
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import PARAMETERS, Values
from cpunet.pulses.peaks import EnergySelection
from cpunet.pulses.shape_parameters import A_OVER_E, all_parameters
from cpunet.pulses.two_sample import TwoSample, classifier_auc
from cpunet.recipes.schema import Recipe
from cpunet.validation.comparisons import Compared, Missing, compare
from cpunet.validation.methods import PairedScores, Translations, scores_of_squares
from cpunet.validation.noise import baseline_spectra

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

    def paired_scores(self) -> dict[str, PairedScores] | None:
        """Paired scores by method; None if the truth is unknown."""
        rows, squares = self.known_to_all(), self.translations.squares
        return {
            name: scores_of_squares(of_method[rows]) for name, of_method in squares.items()
        } or None

    def not_prepared(self) -> dict[str, int]:
        """Number of translated pulses that cannot be prepared like data, by method."""
        raw, whole = self.rows["raw"], self.translations.whole
        counts = {m: int((~usable[raw]).sum()) for m, usable in whole.items() if m != "data"}
        return {name: count for name, count in counts.items() if count}

    def missing(self) -> str | None:
        """Reason why the peak cannot be scored; None if it can."""
        sides = (("simulated", self.rows["raw"]), ("measured", self.rows["data"]))
        few = [f"{len(rows) or 'no'} {side}" for side, rows in sides if len(rows) < MIN_PULSES]
        return f"{' and '.join(few)} pulses (at least {MIN_PULSES} are needed)" if few else None


@dataclass(frozen=True, eq=False)
class PeakScores:
    """Scores of a peak, its entry in ``metrics.json``.

    Attributes
    ----------
    n_sim, n_data
        Numbers of pulses.
    not_prepared
        Number of translated pulses that cannot be prepared like data, by method.
    parameters, further
        Comparison of each parameter, of `PARAMETERS` and of all others.
    two_sample
        Classifier test between each method and the data.
    noise
        Result of `baseline_spectra`.
    paired
        Paired scores by method; None if the truth is unknown.
    missing
        Reason why the peak is not scored.
    """

    n_sim: int
    n_data: int
    not_prepared: dict[str, int]
    parameters: dict[str, Compared] = field(default_factory=dict)
    further: dict[str, Compared] | None = None
    two_sample: dict[str, TwoSample | Missing] | None = None
    noise: Mapping[str, Any] | None = None
    paired: dict[str, PairedScores] | None = None
    missing: str | None = None


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
        `cpunet.validation.fit_errors.moved_values`.
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
    counted = PeakScores(len(peak.rows["raw"]), len(peak.rows["data"]), peak.not_prepared())
    if (missing := peak.missing()) is not None:
        return {}, replace(counted, missing=missing)
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
        scale, _ = scales[method]
        of_method[A_OVER_E] = of_method["current_amplitude"] / scale
        if method != "data":
            ends[method][A_OVER_E] = _normalised(of_method[A_OVER_E], method, scales)
    chief, further = (
        {
            m: {name: v for name, v in of.items() if (name in PARAMETERS) is chosen}
            for m, of in values.items()
        }
        for chosen in (True, False)
    )
    noise = baseline_spectra(
        {method: peak.windows(method)[:, :samples].copy() for method in values},
        {m: recipe.preparation.samples_before + of["t01"] / dt_ns for m, of in values.items()},
        samples,
        dt_ns,
    )
    return values, replace(
        counted,
        parameters=_compared(chief, recipe, seed, ends),
        further=_compared(further, recipe, seed, ends),
        two_sample=classifier_tests(peak, chief, seed),
        noise=noise,
        paired=peak.paired_scores(),
    )


def _normalised(
    values: Values,
    method: str,
    scales: Mapping[str, tuple[float, float]],
) -> Values:
    """A/E over that of the double-escape peak at both ends of each axis of its errors.

    The last axis is the error of both scales.  Parameters of the fit move A/E of both peaks;
    what is left of that is far less than the error of the scales.
    """
    own, other = (scales[m][1] / scales[m][0] for m in ("data", method))
    error = np.hypot(own, other)
    return np.stack([values * (1 + error), values * (1 - error)])[np.newaxis]


def _compared(
    values: ByMethod, recipe: Recipe, seed: int, moved: Mapping[str, Mapping[str, Values]]
) -> dict[str, Compared]:
    methods = {method: of_method for method, of_method in values.items() if method != "data"}
    return compare(values["data"], methods, recipe.scores, seed, moved)


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

    def tested(method: str) -> TwoSample | Missing:
        features = values["data"], values[method]
        try:
            return classifier_auc(data, peak.windows(method), seed=seed, features=features)
        except CpunetError as error:
            return Missing(str(error))

    methods = list(values)[1:]
    with ThreadPoolExecutor(usable_cores()) as pool:
        return dict(zip(methods, pool.map(tested, methods), strict=True))
