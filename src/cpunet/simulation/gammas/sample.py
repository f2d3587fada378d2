"""Hits of the 2614.5 keV gamma line of Tl-208 in a germanium detector."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.gammas.germanium import electron_table, photon_table
from cpunet.simulation.gammas.shape import CrystalShape
from cpunet.simulation.gammas.transport import MAX_HITS, SourceDisc, simulate_block
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hits import Hits

TL208_KEV = 2614.511
"""Energy of the gamma line of Tl-208 in keV."""

_BLOCK_HITS = 1_000_000
_BLOCK_EVENTS = 20_000


class EnergyWindow(NamedTuple):
    """Energies (keV) from `low_kev` to `high_kev`, both included, under a name."""

    name: str
    low_kev: float
    high_kev: float


@dataclass(frozen=True, eq=False)
class GammaStatistics:
    """Counts over all primaries, including events that were not kept.

    ``spectrum`` is the histogram of events with a deposit, in bins of 1 keV from 0.
    """

    n_primaries: int
    spectrum: npt.NDArray[np.int64]


def simulate_gammas(
    detector: Detector,
    *,
    source_height_mm: float,
    source_radius_mm: float,
    n_primaries: int,
    seed: int,
    wanted: Mapping[EnergyWindow, int] = MappingProxyType({}),
    energy_kev: float = TL208_KEV,
) -> tuple[Hits, GammaStatistics]:
    r"""Simulate gammas from a disc above the crystal, in vacuum.

    Gammas are emitted isotropically into the cone around the axis that is as wide as crystal
    and disc together,

    .. math:: \cos\theta > \frac{h}{\sqrt{h^2 + (R + r)^2}},

    so that the simulated fraction of the full solid angle is :math:`(1 - \cos\theta)/2` at
    the limit. Photons undergo Compton scattering (Klein-Nishina with the cross section of
    bound electrons), photoelectric absorption and pair production. Electrons and positrons
    slow down continuously, scatter and radiate. Positrons annihilate at rest or in flight.

    Parameters
    ----------
    detector
        The crystal. Its lithium layer is treated as germanium.
    source_height_mm, source_radius_mm
        Height of the disc above the top of the crystal (z = crystal length) and its radius,
        in mm.
    n_primaries
        Number of gammas in the cone; with `wanted`, the maximum number.
    seed
        Seed of the random generator. The same seed gives the same events.
    wanted
        Number of events requested in each energy window. Only events in a window are kept,
        until each has its number.
    energy_kev
        Energy of the gammas, 50 to 2700 keV.

    Returns
    -------
    Hits
        Events with a deposit. ``event_number`` is the number of the primary.
    GammaStatistics
        Counts over all primaries, including events that were not kept.

    Raises
    ------
    CpunetError
        If a window is empty or beyond the line, or `n_primaries` gammas do not yield the
        requested events.
    """
    for line in wanted:
        if not line.low_kev < line.high_kev or line.low_kev > energy_kev:
            raise CpunetError(
                f"{line.name}: window {line.low_kev} to {line.high_kev} keV holds no event of "
                f"the {energy_kev} keV line; give another"
            )
    shape = CrystalShape.of(detector)
    reach = shape.radius + source_radius_mm
    cosine = source_height_mm / math.hypot(source_height_mm, reach)
    source = SourceDisc(
        energy_kev / 1e3, float(source_height_mm), float(source_radius_mm), cosine
    )
    # the sum of deposits equals the energy of the line only up to rounding
    low = np.array([line.low_kev / 1e3 - 1e-9 for line in wanted])
    high = np.array([line.high_kev / 1e3 + 1e-9 for line in wanted])
    missing = np.array(list(wanted.values()), np.int64)
    spectrum = np.zeros(math.ceil(energy_kev) + 1, np.int64)
    rng = np.random.default_rng(seed)
    hits = np.empty((min(_BLOCK_HITS, MAX_HITS + 300 * n_primaries), 4))
    offsets = np.zeros(_BLOCK_EVENTS + 1, np.int64)
    primaries = np.empty(_BLOCK_EVENTS, np.int64)
    blocks: list[Hits] = [Hits.of([], [], [0])]
    done = 0
    while done < n_primaries and not (wanted and missing.sum() == 0):
        tried, kept = simulate_block(
            shape, source, photon_table(), electron_table(), n_primaries - done,
            low, high, missing, spectrum, rng, hits, offsets, primaries,
        )  # fmt: skip
        ends = offsets[: kept + 1].copy()
        deposits = hits[: ends[-1]]
        blocks.append(
            Hits.of(deposits[:, :3], deposits[:, 3] * 1e3, ends, primaries[:kept] + done)
        )
        done += tried
    if missing.any():
        short = ", ".join(f"{n} of {w.name}" for w, n in zip(wanted, missing, strict=True) if n)
        raise CpunetError(f"{n_primaries} gammas were not enough: {short} missing; allow more")
    return Hits.concatenate(blocks), GammaStatistics(done, spectrum)


def with_resolution(
    energy_kev: npt.ArrayLike, *, noise_kev2: float, fano_kev: float, seed: int
) -> npt.NDArray[np.float64]:
    r"""Smear energies with the Gaussian resolution of a detector.

    .. math:: \mathrm{FWHM}^2 = a + b E

    with :math:`a` in keV² and :math:`b` in keV. The hits are not changed.

    Parameters
    ----------
    energy_kev
        True energies in keV.
    noise_kev2, fano_kev
        Coefficients :math:`a` of the electronic noise and :math:`b` of the Fano statistics.
    seed
        Seed of the random generator.

    Raises
    ------
    CpunetError
        If a coefficient is negative or not finite.

    Examples
    --------
    >>> energies = with_resolution([1592.5] * 4000, noise_kev2=4.0, fano_kev=0.0, seed=1)
    >>> bool(abs(energies.std() * 2.3548 - 2.0) < 0.1)
    True
    """
    if not (noise_kev2 >= 0 and fano_kev >= 0 and math.isfinite(noise_kev2 + fano_kev)):
        raise CpunetError(f"FWHM² = {noise_kev2} + {fano_kev} E; give numbers from 0 up")
    energy = np.asarray(energy_kev, float)
    fwhm = np.sqrt(noise_kev2 + fano_kev * energy)
    sigma = fwhm / math.sqrt(8 * math.log(2))
    return np.random.default_rng(seed).normal(energy, sigma)
