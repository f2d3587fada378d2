"""What is kept of the raw traces of a file while they are read once, and what it tells."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.baselines import TRACES, WHOLE, Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.doubts import apart, go_down, second_rate
from cpunet.pulses.peaks import EnergySelection
from cpunet.pulses.preparation import Kind, Prepared
from cpunet.pulses.provenance import require_apparent_side, require_recorded_side
from cpunet.pulses.reading.energies import amplitude
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.spectrum import suggested_calibration
from cpunet.recipes.schema import PreparationConfig

log = logging.getLogger(__name__)

Energies = npt.NDArray[np.float64]

MAX_KEV, MIN_KEV = 20_000.0, 20.0  # typical range of gamma energies
LOW_KEV = 300.0  # at lower energies noise hides the pulse shapes
# Share of pulses whose amplitude and energy do not go together, from which they are refused,
# and from which a warning tells of it; traces in which a second rate is looked for.
MAX_APART, FEW_APART, RATE_TRACES = 0.2, 0.1, 512
SWAPPED = "are `sim` and `data` swapped?"


class Seen:
    """What is kept of raw traces while they are read once: baselines, signs of mistakes.

    Parameters
    ----------
    source, side
        The file, and whether its pulses are given as simulated or measured ones.
    config
        Preparation of measured traces.
    insist
        Whether the pulses are taken as given, whatever they look like.

    Raises
    ------
    CpunetError
        If the file says that its pulses are of the other side; by a call, if they look so.
    """

    def __init__(
        self, source: PulseSource, side: Kind, config: PreparationConfig, *, insist: bool
    ) -> None:
        self._path, self._side, self._config, self._insist = source.path, side, config, insist
        self._recorded = require_recorded_side(source, side, SWAPPED)
        self._kev, self._amplitudes = list[Energies](), list[Energies]()
        self._first: npt.NDArray[np.float32] | None = None
        self._baselines = list[Baselines]()
        self._whole, self._rows = list[Pulses](), list[npt.NDArray[np.int64]]()

    def __call__(self, block: Pulses, usable: Prepared) -> None:
        """Keep what is needed of a block, of which some pulses can be used."""
        if self._first is None:
            if not (self._recorded or self._insist):
                require_apparent_side(self._path, block.waveforms, self._side, SWAPPED)
            self._first = block.waveforms[:RATE_TRACES].copy()
        self._kev.append(block.energy_kev)
        self._amplitudes.append(amplitude(block.waveforms))
        if self._side == "simulated":
            return
        if sum(map(len, self._baselines)) < TRACES:
            like = self._baselines[:1]
            self._baselines.append(Baselines.of_block(block, self._config, *like))
        if (wanted := WHOLE - sum(map(len, self._whole))) > 0:
            self._rows.append(usable.index[:wanted])
            self._whole.append(block[self._rows[-1] - usable.first_index])

    def baselines(self, kept: Prepared) -> Baselines:
        """Baselines, and whole traces of the pulses that are kept."""
        stay = np.isin(np.concatenate(self._rows), kept.index)
        return Baselines.concatenate(self._baselines, Pulses.concatenate(self._whole)[stay])

    @property
    def energies_kev(self) -> Energies:
        """The known energies."""
        kev: Energies = np.concatenate([np.empty(0), *self._kev])
        return kev[np.isfinite(kev)]

    def explained(self, error: CpunetError, selection: EnergySelection) -> CpunetError:
        """Why no pulse can be used, if what was read tells: polarity, energies, calibration."""
        if self._first is not None and go_down(self._first):
            return CpunetError(
                f"{self._path}: the traces go down: their polarity is negative",
                "turn them round, as by pulses.with_waveforms(-pulses.waveforms) in Python",
            )
        known = self.energies_kev
        if len(known):
            none = not selection.select(known).any()
            return CpunetError(f"{error}{_where_energies_are(known)}") if none else error
        found = suggested_calibration(np.concatenate([np.empty(0), *self._amplitudes]))
        if found is None:
            return error
        return CpunetError(f"{error}; their amplitudes look like {found}")

    def require_sense(self) -> None:
        """Refuse energies that are of other pulses; warn of a second rate."""
        if self._insist or self._first is None:
            return
        share = apart(np.concatenate(self._kev), np.concatenate(self._amplitudes))
        told = (
            f"{self._path}: {100 * share:.0f} % of amplitudes and energies do not go together"
        )
        if share > MAX_APART:
            raise CpunetError(
                f"{told}: these energies are not those of these traces",
                "give the energy column of the same channel and events, in their order",
            )
        if share > FEW_APART:
            log.warning(told)
        if (found := second_rate(self._first)) is not None:
            log.warning(f"{self._path}: {found}; cut the traces there, or resample them")


def _where_energies_are(energies: Energies) -> str:
    """Hint on the range of energies in a file of which none is selected."""
    low, middle, high = np.quantile(energies, (0.05, 0.5, 0.95))
    there = f". Energies there: {low:.4g} to {high:.4g} keV, half of them above {middle:.4g}"
    if high > MAX_KEV:
        return f"{there}: if these are ADC counts, give `kev_per_adc`"
    if 0 < high < MIN_KEV:
        return f"{there}: if these are MeV, give `kev_per_adc` 1000"
    from_kev = max(np.floor(low / 100) * 100, LOW_KEV)
    n = int((energies >= from_kev).sum())
    if not n:
        return there
    return f"{there}; `peak` {from_kev:.0f}- takes {n} pulses"
