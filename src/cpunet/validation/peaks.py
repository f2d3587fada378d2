"""The pulses of one peak by method, and their scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.plotting import NO_NOISE
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import PARAMETERS, Values
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.recipes.schema import Recipe
from cpunet.validation.comparisons import Compared, Missing, compare
from cpunet.validation.methods import PairedScores, Translations, scores_of_squares
from cpunet.validation.noise import baseline_spectra
from cpunet.validation.two_sample import TwoSample, classifier_auc

MIN_PULSES = 10  # minimum number of pulses of a distribution

Rows = npt.NDArray[np.int64]
ByMethod = dict[str, dict[str, Values]]


@dataclass(frozen=True, eq=False)
class PeakSets:
    """The simulated and measured pulses of one peak, as rows of the whole datasets.

    Parameters
    ----------
    name
        Name of a peak of the recipe, or a range in keV.
    measured
        All prepared measured pulses.
    sim_rows, data_rows
        Rows of the pulses of the peak.
    translations
        Translations of the simulated pulses by all methods.
    amplitudes
        Current amplitudes of all pulses of each side and method, with noise.
    """

    name: str
    measured: Pulses
    sim_rows: Rows
    data_rows: Rows
    translations: Translations
    amplitudes: Mapping[str, Values]

    @property
    def raw(self) -> Pulses:
        """The simulated pulses of the peak."""
        return self.translations.simulated[self.sim_rows]

    @property
    def data(self) -> Pulses:
        """The measured pulses of the peak."""
        return self.measured[self.data_rows]

    @property
    def dt_ns(self) -> float:
        """Sampling period in ns."""
        return self.translations.simulated.dt_ns

    def rows(self, method: str) -> Rows:
        """Rows of the pulses with noise of one method in its whole dataset."""
        if method in ("data", "raw"):
            return self.data_rows if method == "data" else self.sim_rows
        return self._prepared(self.translations.whole[method])

    @property
    def methods(self) -> list[str]:
        """The data, then the methods with noise from the simplest to the truth."""
        translated = self.translations.whole
        enough = [m for m in translated if len(self.rows(m)) >= MIN_PULSES or m == "ren"]
        return ["data", "raw", *enough]

    def pulses(self, method: str) -> Pulses:
        """Pulses with noise of a method, copied from its whole dataset."""
        if method in ("data", "raw"):
            return self.data if method == "data" else self.raw
        return Pulses.of(self.translations.noisy[method][self.rows(method)], dt_ns=self.dt_ns)

    def noise_free_parameters(self) -> dict[str, dict[str, Values]]:
        """Parameters of the noise-free pulses of the baseline methods and of the truth."""
        found = {}
        for name, kept in self.translations.clean.items():
            rows = self._prepared(kept.whole)
            if name not in ("raw", "ren") and len(rows) >= MIN_PULSES:
                found[f"{name}{NO_NOISE}"] = {k: v[rows] for k, v in kept.parameters.items()}
        return found

    def known_to_all(self) -> Rows:
        """Indices within the peak of the events that all methods have without noise."""
        whole = [kept.whole[self.sim_rows] for kept in self.translations.clean.values()]
        return np.flatnonzero(np.logical_and.reduce(whole))

    def without_noise(self, places: Rows) -> dict[str, FloatArray]:
        """Noise-free windows of some events by method, with the truth if it is known."""
        return self.translations.without_noise(self.sim_rows[places])

    def paired_scores(self) -> dict[str, PairedScores] | None:
        """Paired scores by method; None if the truth is unknown."""
        rows = self.sim_rows[self.known_to_all()]
        scores = {
            name: scores_of_squares(kept.squares[rows])
            for name, kept in self.translations.clean.items()
            if kept.squares is not None
        }
        return scores or None

    def not_prepared(self) -> dict[str, int]:
        """Number of translated pulses that cannot be prepared like data, by method."""
        whole = dict(self.translations.whole)
        for name, kept in self.translations.clean.items():
            if name not in ("raw", "ren"):
                whole[f"{name}{NO_NOISE}"] = kept.whole
        counts = {name: int((~kept[self.sim_rows]).sum()) for name, kept in whole.items()}
        return {name: count for name, count in counts.items() if count}

    def missing(self) -> str | None:
        """Reason why the peak cannot be scored; None if it can."""
        sides = (("simulated", self.sim_rows), ("measured", self.data_rows))
        few = [f"{len(rows) or 'no'} {side}" for side, rows in sides if len(rows) < MIN_PULSES]
        return f"{' and '.join(few)} pulses (at least {MIN_PULSES} are needed)" if few else None

    def _prepared(self, flags: npt.NDArray[np.bool_]) -> Rows:
        return self.sim_rows[flags[self.sim_rows]]


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


def score_peak(peak: PeakSets, recipe: Recipe, seed: int) -> tuple[ByMethod, PeakScores]:
    """Compare the pulses of a peak, method by method.

    Parameters
    ----------
    peak
        Pulses of the peak.
    recipe
        Recipe of the run.
    seed
        Seed of bootstraps and folds.

    Returns
    -------
    values
        Pulse-shape parameters by method and name: all of `SHAPE_PARAMETERS`, or only those
        of `PARAMETERS` for methods without noise.  Empty if the peak is not scored.
    scores
        Scores of the peak.
    """
    counted = PeakScores(len(peak.sim_rows), len(peak.data_rows), peak.not_prepared())
    if (missing := peak.missing()) is not None:
        return {}, replace(counted, missing=missing)
    values = {
        method: all_parameters(
            peak.pulses(method),
            recipe.preparation,
            recipe.scores,
            amplitudes=peak.amplitudes[method][peak.rows(method)],
        )
        for method in peak.methods
    } | peak.noise_free_parameters()
    chief = {method: {name: v[name] for name in PARAMETERS} for method, v in values.items()}
    further = {
        method: {name: v for name, v in of_method.items() if name not in PARAMETERS}
        for method, of_method in values.items()
        if not method.endswith(NO_NOISE)
    }
    align, dt_ns = recipe.preparation.samples_before, peak.dt_ns
    samples = recipe.preparation.baseline_samples
    noise = baseline_spectra(
        {method: peak.pulses(method).waveforms[:, :samples].copy() for method in peak.methods},
        {method: align + values[method]["t01"] / dt_ns for method in peak.methods},
        samples,
        dt_ns,
    )
    return values, replace(
        counted,
        parameters=_compared(chief, recipe, seed),
        further=_compared(further, recipe, seed),
        two_sample=classifier_tests(peak, chief, seed),
        noise=noise,
        paired=peak.paired_scores(),
    )


def _compared(values: ByMethod, recipe: Recipe, seed: int) -> dict[str, Compared]:
    methods = {method: of_method for method, of_method in values.items() if method != "data"}
    return compare(values["data"], methods, recipe.scores, seed)


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
    tested: dict[str, TwoSample | Missing] = {}
    data = peak.data.waveforms
    for method in peak.methods[1:]:
        others, features = peak.pulses(method).waveforms, (values["data"], values[method])
        try:
            tested[method] = classifier_auc(data, others, seed=seed, features=features)
        except CpunetError as error:
            tested[method] = Missing(str(error))
    return tested
