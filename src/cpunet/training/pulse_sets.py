"""Two sets of pulses, divided into bands of energy in which they are compared.

Lines and continua have different mixtures of single-site and multi-site events, and noise
scales as 1/energy.  Pulses of a line are therefore compared with those of the same line, and a
continuum is compared in bands narrow enough for a constant mixture.  If the spectra of the two
sides differ within such a band, the simulated pulses are weighted to match the data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise, require_energies
from cpunet.electronics.drawn_pile_up import DrawnTails
from cpunet.errors import CpunetError
from cpunet.networks.response_layer import record_length
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.loading import InputSet
from cpunet.pulses.peaks import EnergySelection, label_peaks, parse_selection
from cpunet.recipes.schema import PeakConfig, Recipe
from cpunet.training.aligned import Frame, Samples, Values
from cpunet.training.bands import Noise, Sides
from cpunet.training.comparison import MOST

# Ratio of the limits of a band; the next is used only if no band of the previous is possible.
WIDEST = (1.3, 2.0, 4.0, np.inf)
# Maximum number of slices of a band in which the spectra are matched, and pulses in a slice.
SLICES, IN_SLICE = 32, 50
# The continuum begins where noise is small, and ends well before a line and its sidebands.
CONTINUUM_FROM_KEV, CLEAR_KEV = 1000.0, 50.0
HEAVIEST = 5.0  # maximum weight of a simulated pulse before normalisation
MIN_PULSES = 200  # of a side, for a covariance
NOISES = 1000  # draws of noise that few pulses have, for the same
# Pulses that give the slope of the tails
DRAWN = 8192

SINGLE = "single sites of the continuum"

Continuum = Callable[[], tuple[InputSet, InputSet]]


@dataclass(frozen=True, eq=False)
class EnergyBand:
    """Pulses of both sides that are compared with each other.

    Parameters
    ----------
    name
        A line, or a range in keV.
    sim, data
        Samples of the two sides.
    weights
        Weights of the simulated pulses, with a mean of 1.
    """

    name: str
    sim: Samples
    data: Samples
    weights: Values


def energy_bands(
    sim_kev: Values, data_kev: Values, peaks: Mapping[str, PeakConfig]
) -> list[EnergyBand]:
    """Divide two sets of pulses into bands of energy.

    Parameters
    ----------
    sim_kev, data_kev
        Energies of the pulses to be compared, on the two sides.
    peaks
        Gamma lines.

    Returns
    -------
    list of EnergyBand
        Lines first.  Energies with too few pulses of a side are in no band.

    Raises
    ------
    CpunetError
        If no band has enough pulses of both sides.

    Examples
    --------
    >>> lines = {"FEP": PeakConfig(energy_kev=2614.5, half_width_kev=5)}
    >>> sim = np.r_[np.full(500, 2614.5), np.linspace(1000, 1200, 900)]
    >>> data = np.r_[np.full(400, 2614.0), np.linspace(1000, 1200, 800)]
    >>> [(b.name, len(b.sim), len(b.data)) for b in energy_bands(sim, data, lines)]
    [('FEP', 500, 400), ('1000-1200 keV', 900, 800)]
    """
    labels = [label_peaks(side, peaks) for side in (sim_kev, data_kev)]
    bands = []
    for name in peaks:
        sim, data = (np.flatnonzero(of == name) for of in labels)
        if min(len(sim), len(data)) >= MIN_PULSES:
            bands.append(EnergyBand(name, sim, data, np.ones(len(sim))))
    inside = {band.name for band in bands}
    sim, data = (np.flatnonzero(~np.isin(of, [*inside])) for of in labels)
    for widest in WIDEST:
        bands += _continuum(sim_kev, data_kev, sim, data, widest)
        if bands:
            break
    else:
        raise CpunetError(
            f"{len(sim_kev)} simulated and {len(data_kev)} measured pulses; {MIN_PULSES} of "
            "each at the same energies are needed: select more energies (`peak`), simulate "
            "more, or give more files"
        )
    return bands


def _continuum(
    sim_kev: Values, data_kev: Values, sim: Samples, data: Samples, widest: float
) -> list[EnergyBand]:
    """Bands of the pulses that are not in a line, from the highest energy down."""
    bands, energies = [], (sim_kev, data_kev)
    rows = [side[np.argsort(-e[side])] for side, e in zip((sim, data), energies, strict=True)]
    while min(map(len, rows)):
        top = min(e[r[0]] for r, e in zip(rows, energies, strict=True))
        rows = [r[e[r] <= top] for r, e in zip(rows, energies, strict=True)]
        inside = (e[r] >= top / widest for r, e in zip(rows, energies, strict=True))
        counts = [int(of.sum()) for of in inside]
        left = [len(r) - n for r, n in zip(rows, counts, strict=True)]
        if min(counts) >= MIN_PULSES and min(left) < MIN_PULSES and max(left) < 2 * MIN_PULSES:
            counts = [len(r) for r in rows]  # include a small remainder
        parts = [np.sort(r[:n]) for r, n in zip(rows, counts, strict=True)]
        if min(counts) >= MIN_PULSES:
            low = min(e[r].min() for r, e in zip(parts, energies, strict=True))
            weights = spectrum_weights(sim_kev[parts[0]], data_kev[parts[1]])
            if weights.any():
                name = f"{low:.0f}-{top:.0f} keV"
                bands.append(EnergyBand(name, parts[0], parts[1], weights))
        rows = [r[max(n, 1) :] for r, n in zip(rows, counts, strict=True)]
    return bands


def continuum(recipe: Recipe) -> EnergySelection:
    """Energies below the highest line, away from all lines and from what scores look at.

    Examples
    --------
    >>> from cpunet.recipes import load_recipe
    >>> continuum(load_recipe("fast")).name
    '1000-1543,1643-2004,2154-2565'
    """
    centres = [line.energy_kev for line in recipe.peaks.values()]
    used = [(kev - CLEAR_KEV, kev + CLEAR_KEV) for kev in centres]
    used += recipe.scores.continuum_kev.values()
    ranges, first = [], CONTINUUM_FROM_KEV
    for low, stop in sorted(used):
        if low > first:
            ranges.append(f"{first:.0f}-{low:.0f}")
        first = max(first, stop)
    return parse_selection(",".join(ranges), recipe.peaks)


def spectrum_weights(sim_kev: Values, data_kev: Values) -> Values:
    """Weights of simulated pulses that give them the data's spectrum, with a mean of 1.

    All are 0 if the spectra do not overlap.
    """
    slices = max(2, min(SLICES, min(len(sim_kev), len(data_kev)) // IN_SLICE))
    edges = np.quantile(data_kev, np.linspace(0, 1, slices + 1)[1:-1])
    of_sim, of_data = np.searchsorted(edges, sim_kev), np.searchsorted(edges, data_kev)
    counts = [np.bincount(of, minlength=slices) for of in (of_sim, of_data)]
    ratio = (counts[1] / len(data_kev)) / np.maximum(counts[0] / len(sim_kev), 1e-9)
    weights = np.minimum(ratio, HEAVIEST)[of_sim]
    return np.asarray(weights / max(weights.mean(), 1e-9))


@dataclass(eq=False)
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

    Attributes
    ----------
    parted, names
        Each band, with its pulses of both sides in random order; their names.
    tail_slope
        Median slope per sample of the logarithm of the data's tails.

    Raises
    ------
    CpunetError
        If the pulses are too few, or an energy is missing.
    """

    sim: Pulses
    data: Pulses
    noise: BaselineNoise
    recipe: Recipe
    rng: np.random.Generator
    tails: DrawnTails | None = None
    continuum: Continuum | None = None

    def __post_init__(self) -> None:
        require_energies(self.sim.energy_kev)
        both = self.sim.energy_kev, self.data.energy_kev
        # in random order, so that any first part is representative
        self.parted = [
            (band, [self.rng.permutation(len(rows)) for rows in (band.sim, band.data)])
            for band in energy_bands(*both, self.recipe.peaks)
        ]
        self.names = [band.name for band, _ in self.parted]
        samples = self.recipe.preparation.decay_fit_samples
        lever = np.arange(samples) - 0.5 * (samples - 1)
        tails = self.data.waveforms[spread(len(self.data), DRAWN), -samples:]
        slopes = np.log(np.maximum(tails, 1e-3)) @ (lever / (lever @ lever))
        self.tail_slope = float(np.nanmedian(slopes))

    def sides(self) -> list[Sides]:
        """Pulses of both sides in each band, for the comparison at every sample."""
        sides = []
        for band, (of_sim, of_data) in self.parted:
            data, some = self.data.waveforms[band.data[of_data[:MOST]]], of_sim[:MOST]
            sides.append(self._sides(self.sim, band.sim[some], data, band.weights[some]))
        return sides

    def single_sites(self) -> list[Sides]:
        """Pulses of the continuum, whose single sites are compared; none if they are few."""
        if self.continuum is None:
            return []
        sim, data = (side.prepared.pulses for side in self.continuum())
        rows, of_data = (self.rng.permutation(len(side))[:MOST] for side in (sim, data))
        if min(len(rows), len(of_data)) < MIN_PULSES:
            return []
        weights = spectrum_weights(sim.energy_kev[rows], data.energy_kev[of_data])
        return [self._sides(sim, rows, data.waveforms[of_data], weights)]

    def _sides(self, sim: Pulses, rows: Samples, data: FloatArray, weights: Values) -> Sides:
        preparation, training = self.recipe.preparation, self.recipe.matching.training
        if np.ptp(weights) > 0:  # each as often as its weight says, to a whole number
            share = np.cumsum(weights) / weights.sum()
            rows = rows[np.searchsorted(share, (np.arange(len(rows)) + 0.5) / len(rows))]
        sim, data = sim[rows], data[np.isfinite(data).all(axis=1)]
        length, kev = record_length(sim.waveforms.shape[1], sim.dt_ns), sim.energy_kev
        pairs = max(1, round(NOISES / len(sim)))
        noise = Noise.draw(self.noise, kev, length, pairs, self.rng, self.tails)
        frame, level = Frame.of(training), preparation.tail_level
        return Sides(sim.waveforms, data, noise, frame, level, kev, rows)


def spread(n: int, most: int) -> Samples:
    """Samples of at most `most` of `n` pulses, spread over all: files can be in any order."""
    return np.linspace(0, n - 1, min(n, most)).astype(np.intp)
