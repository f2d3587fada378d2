"""The pulses of one peak by method, for a validation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from cpunet.plotting import NO_NOISE
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.loading import InputSet
from cpunet.pulses.parameters import Values, current_amplitude
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes.schema import Recipe
from cpunet.validation.methods import Translations
from cpunet.validation.paired import PairedScores, scores_of_squares
from cpunet.validation.when_asked import WhenAsked

MIN_PULSES = 10  # minimum number of pulses of a distribution

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PeakSets:
    """The simulated and measured pulses of one peak, as rows of the whole datasets.

    Parameters
    ----------
    name
        Name of a peak of the recipe, or a range in keV.
    simulated, measured
        All prepared pulses of the two sides.
    sim_rows, data_rows
        Rows of the pulses of the peak.
    made
        Translations of the simulated pulses by all methods.
    amplitudes
        Current amplitudes of all pulses with noise, see `current_amplitudes`.
    """

    name: str
    simulated: Pulses
    measured: Pulses
    sim_rows: Rows
    data_rows: Rows
    made: Translations
    amplitudes: Mapping[str, Values]

    @property
    def raw(self) -> Pulses:
        """The simulated pulses of the peak."""
        return self.simulated[self.sim_rows]

    @property
    def data(self) -> Pulses:
        """The measured pulses of the peak."""
        return self.measured[self.data_rows]

    @property
    def dt_ns(self) -> float:
        """Sampling period in ns."""
        return self.simulated.dt_ns

    def by_method(self) -> WhenAsked[Pulses]:
        """Pulses with noise by method: the data, then from the simplest method to the truth.

        They are copied from the whole dataset on every access.
        """
        makers: dict[str, Callable[[], Pulses]] = {
            "data": lambda: self.data,
            "raw": lambda: self.raw,
        }
        for name, whole in self.made.whole.items():
            rows = self._whole(whole)
            if len(rows) >= MIN_PULSES or name == "ren":
                makers[name] = partial(self._noisy, name, rows)
        return WhenAsked(makers)

    def amplitudes_of(self, method: str) -> Values:
        """Current amplitudes of the pulses with noise of one method, see `by_method`."""
        rows = {"data": self.data_rows, "raw": self.sim_rows}
        chosen = rows[method] if method in rows else self._whole(self.made.whole[method])
        return self.amplitudes[method][chosen]

    def noise_free_parameters(self) -> dict[str, dict[str, Values]]:
        """Parameters of the noise-free pulses of the baseline methods and of the truth."""
        found = {}
        for name, kept in self.made.clean.items():
            rows = self._whole(kept.whole)
            if name not in ("raw", "ren") and len(rows) >= MIN_PULSES:
                found[f"{name}{NO_NOISE}"] = {k: v[rows] for k, v in kept.parameters.items()}
        return found

    def known_to_all(self) -> Rows:
        """Indices within the peak of the events that all methods have without noise."""
        whole = [kept.whole[self.sim_rows] for kept in self.made.clean.values()]
        return np.flatnonzero(np.logical_and.reduce(whole))

    def without_noise(self, places: Rows) -> dict[str, FloatArray]:
        """Noise-free windows of some events by method, with the truth if it is known."""
        return self.made.without_noise(self.sim_rows[places])

    def paired_scores(self) -> dict[str, PairedScores] | None:
        """Paired scores by method; None if the truth is unknown."""
        rows = self.sim_rows[self.known_to_all()]
        scores = {
            name: scores_of_squares(kept.squares[rows])
            for name, kept in self.made.clean.items()
            if kept.squares is not None
        }
        return scores or None

    def not_prepared(self) -> dict[str, int]:
        """Number of translated pulses that cannot be prepared like data, by method."""
        whole = dict(self.made.whole)
        for name, kept in self.made.clean.items():
            if name not in ("raw", "ren"):
                whole[f"{name}{NO_NOISE}"] = kept.whole
        counts = {name: int((~kept[self.sim_rows]).sum()) for name, kept in whole.items()}
        return {name: count for name, count in counts.items() if count}

    def missing(self) -> str | None:
        """Reason why the peak cannot be scored; None if it can."""
        sides = (("simulated", self.sim_rows), ("measured", self.data_rows))
        few = [f"{len(rows) or 'no'} {side}" for side, rows in sides if len(rows) < MIN_PULSES]
        return f"{' and '.join(few)} pulses (at least {MIN_PULSES} are needed)" if few else None

    def _whole(self, flags: npt.NDArray[np.bool_]) -> Rows:
        return self.sim_rows[flags[self.sim_rows]]

    def _noisy(self, name: str, rows: Rows) -> Pulses:
        return Pulses.of(self.made.noisy[name][rows], dt_ns=self.dt_ns)


def current_amplitudes(
    sim_set: InputSet, data_set: InputSet, made: Translations
) -> dict[str, Values]:
    """Current amplitudes of all pulses of the data, of the simulation, and with noise."""
    windows = {
        "raw": sim_set.prepared.pulses.waveforms,
        **made.noisy,
        "data": data_set.prepared.pulses.waveforms,
    }
    return {method: current_amplitude(of_method) for method, of_method in windows.items()}


def peak_sets(
    name: str,
    recipe: Recipe,
    sim_set: InputSet,
    data_set: InputSet,
    made: Translations,
    amplitudes: Mapping[str, Values],
) -> PeakSets:
    """Select the pulses of one peak, or of a range of energies, from both datasets.

    Parameters
    ----------
    name
        Name of a peak of the recipe, or a range in keV.
    recipe
        Recipe of the run.
    sim_set, data_set
        Prepared pulses of both sides.
    made
        Translations of the simulated pulses by all methods.
    amplitudes
        Result of `current_amplitudes`.
    """
    selection = parse_selection(name, recipe.peaks)
    sim, data = sim_set.prepared.pulses, data_set.prepared.pulses
    rows = [np.flatnonzero(selection.select(side.energy_kev)) for side in (sim, data)]
    return PeakSets(name, sim, data, rows[0], rows[1], made, amplitudes)
