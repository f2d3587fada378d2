"""Two sets of pulses, divided into bands of energy in which they are compared.

Lines and continua have different mixtures of single-site and multi-site events, and noise
scales as 1/energy.  Pulses of a line are therefore compared with those of the same line, and a
continuum is compared in bands narrow enough for a constant mixture.  If the spectra of the two
sides differ within such a band, the simulated pulses are weighted to match the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.peaks import EnergySelection, label_peaks, parse_selection
from cpunet.recipes.schema import PeakConfig, Recipe
from cpunet.training.aligned import Samples, Values

# Ratios of the limits of a band: the first with enough pulses; the next are used only if no
# band of the previous is possible.  What acts by height, as a curve of seven waves in the range
# of a digitiser, averages out in wide ones.
WIDEST = (1.1, 1.3), (2.0,), (4.0,), (np.inf,)
# Maximum number of slices of a band in which the spectra are matched, and pulses in a slice.
SLICES, IN_SLICE = 32, 50
# The continuum begins where noise is small, and ends well before a line and its sidebands.
CONTINUUM_FROM_KEV, CLEAR_KEV = 1000.0, 50.0
HEAVIEST = 5.0  # maximum weight of a simulated pulse before normalisation
MIN_PULSES = 200  # of a side, for a covariance


class EnergyBand(NamedTuple):
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
    [('FEP', 500, 400), ('1091-1200 keV', 491, 436), ('1000-1091 keV', 409, 363)]
    """
    bands, energies = list[EnergyBand](), (sim_kev, data_kev)
    labels = [label_peaks(side, peaks) for side in energies]
    for name in peaks:
        sim, data = (np.flatnonzero(of == name) for of in labels)
        if min(len(sim), len(data)) >= MIN_PULSES:
            bands.append(EnergyBand(name, sim, data, np.ones(len(sim))))
    # pulses that are not in a line, from the highest energy down
    inside = [band.name for band in bands]
    others = [np.flatnonzero(~np.isin(of, inside)) for of in labels]
    for ratios in WIDEST:
        rows = [r[np.argsort(-e[r])] for r, e in zip(others, energies, strict=True)]
        while min(map(len, rows)):
            top = min(e[r[0]] for r, e in zip(rows, energies, strict=True))
            rows = [r[e[r] <= top] for r, e in zip(rows, energies, strict=True)]
            for ratio in ratios:
                both = zip(rows, energies, strict=True)
                counts = [int((e[r] >= top / ratio).sum()) for r, e in both]
                if enough := min(counts) >= MIN_PULSES:
                    break
            left = [len(r) - n for r, n in zip(rows, counts, strict=True)]
            if enough and min(left) < MIN_PULSES and max(left) < 2 * MIN_PULSES:
                counts = [len(r) for r in rows]  # include a small remainder
            if enough:
                sim, data = (np.sort(r[:n]) for r, n in zip(rows, counts, strict=True))
                weights = spectrum_weights(sim_kev[sim], data_kev[data])
                if weights.any():
                    name = f"{min(sim_kev[sim].min(), data_kev[data].min()):.0f}-{top:.0f} keV"
                    bands.append(EnergyBand(name, sim, data, weights))
            rows = [r[max(n, 1) :] for r, n in zip(rows, counts, strict=True)]
        if bands:
            return bands
    raise CpunetError(
        f"{len(sim_kev)} simulated and {len(data_kev)} measured pulses; {MIN_PULSES} of "
        "each at the same energies are needed: select more energies (`peak`), simulate "
        "more, or give more files"
    )


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
