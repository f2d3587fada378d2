"""Two sets of pulses, divided into bands of energy for comparison."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise, require_energies
from cpunet.electronics.drawn_tails import DrawnTails
from cpunet.networks.response_layer import record_length
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.recipes.schema import Recipe
from cpunet.training.energy_bands import EnergyBand, energy_bands, spectrum_weights
from cpunet.training.moments import Moments, Rows, TooFewPulsesError, Values
from cpunet.training.response_problem import Band
from cpunet.training.translated import Noise, Translated

# Minimum number of pulses of a band if only some of a set are taken.
MIN_OF_BAND = 400
Continuum = Callable[[], tuple[Pulses, Pulses]]
SINGLE = "single sites of the continuum"  # name of their band
# Draws of the noise of single sites, of which there are few, for each of other pulses.
MORE_DRAWS = 4


class PulseSets:
    """Both sides in bands of energy, and representative subsets of them.

    Parameters
    ----------
    sim, data
        Prepared pulses with their energies.
    noise
        Noise of the data's baselines.
    recipe
        Recipe that matches a response.
    rng
        Random generator that chooses the subsets and draws the noise.
    tails
        Pile-up tails in the data.
    continuum
        Reads the pulses of both sides away from all lines, for `single_sites`.

    Raises
    ------
    CpunetError
        If there are too few pulses, or an energy is not known.
    """

    def __init__(
        self,
        sim: Pulses,
        data: Pulses,
        noise: BaselineNoise,
        recipe: Recipe,
        rng: np.random.Generator,
        tails: DrawnTails | None = None,
        continuum: Continuum | None = None,
    ) -> None:
        self.sim, self.data, self.noise, self.recipe, self.rng = sim, data, noise, recipe, rng
        self.tails, self.continuum = tails, continuum
        require_energies(sim.energy_kev)
        parted = energy_bands(sim.energy_kev, data.energy_kev, recipe.peaks)
        # in random order, so that any first part is representative
        self.parted = [
            (band, rng.permutation(len(band.sim)), rng.permutation(len(band.data)))
            for band in parted
        ]

    def bands(self, most: int | None = None) -> list[Band]:
        """All pulses, or about `most` of each side, in the same proportions."""
        n_sim, n_data = (
            sum(len(order) for order in orders)
            for orders in zip(*(parts[1:] for parts in self.parted), strict=True)
        )
        some = []
        for band, sim_order, data_order in self.parted:
            chosen = []
            for order, n in ((sim_order, n_sim), (data_order, n_data)):
                share = 1.0 if most is None else min(1.0, most / n)
                kept = max(math.ceil(share * len(order)), min(MIN_OF_BAND, len(order)))
                chosen.append(np.sort(order[:kept]))
            some.append(self._band(band, *chosen))
        return some

    def single_sites(self) -> list[Band]:
        """Single sites of the continuum, whose peak of the current amplitude is compared.

        There are none if the pulses are too few.
        """
        if self.continuum is None:
            return []
        sim, data = self.continuum()
        _, training = self.recipe.matching
        try:
            moments = Moments.of_data(data.waveforms, training, self.recipe.preparation)
        except TooFewPulsesError:
            return []
        weights = spectrum_weights(sim.energy_kev, data.energy_kev)
        draws = MORE_DRAWS * training.noise_sets
        translated = self._translated(sim, moments.single_sites(), weights, draws)
        return [Band(SINGLE, translated, np.arange(len(sim)))]

    def _band(self, band: EnergyBand, sim: Rows, data: Rows) -> Band:
        _, training = self.recipe.matching
        measured = _taken(self.data.waveforms, band.data[data])
        moments = Moments.of_data(measured, training, self.recipe.preparation)
        rows = band.sim[sim]
        pulses = self.sim if len(rows) == len(self.sim) else self.sim[rows]
        weights, draws = band.weights[sim], training.noise_sets
        return Band(band.name, self._translated(pulses, moments, weights, draws), rows)

    def _translated(
        self, sim: Pulses, moments: Moments, weights: Values, draws: int
    ) -> Translated:
        length = record_length(sim.waveforms.shape[1])
        drawn = Noise.draw(self.noise, sim.energy_kev, length, draws, self.rng, self.tails)
        return Translated(sim.waveforms, drawn, moments, weights)


def _taken(waveforms: FloatArray, rows: Rows) -> FloatArray:
    """Rows in their order; without a copy, which may take gigabytes, if all are taken."""
    return waveforms if len(rows) == len(waveforms) else waveforms[rows]
