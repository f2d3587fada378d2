"""What is kept of the raw traces of a file while they are read once, and mistakes they betray.

Among these are wrong polarity, energies of other events, and a second rate.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.baselines import TRACES, WHOLE, Baselines
from cpunet.pulses.container import Pulses
from cpunet.pulses.description import rolled_over
from cpunet.pulses.peaks import EnergySelection
from cpunet.pulses.preparation import Kind, Prepared
from cpunet.pulses.provenance import apparent_side, recorded_side, refuse_other_side
from cpunet.pulses.reading.energies import amplitude
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.spectrum import suggested_calibration
from cpunet.recipes.schema import PreparationConfig

Values = npt.NDArray[np.float64]
Traces = npt.NDArray[np.float32]

LOW_KEV = 300.0  # at lower energies, noise can be a good part of an amplitude
# Relative deviation from the common gain of what does not go together, and share of pulses up
# to which amplitudes may differ as much and yet be all alike.
APART, ALIKE = 0.1, 0.1
MIN_PULSES = 30
# Samples over which noise is averaged, least part of the tail on either side of a change of
# rate, and least factors by which noise and slope change there.
SMOOTHED, MARGIN, MIN_NOISE, MIN_SLOPE = 64, 0.1, 1.2, 1.5


def go_down(traces: Traces) -> bool:
    """Whether most traces of shape (pulses, samples) fall from their baselines."""
    if not len(traces):
        return False
    up, down = amplitude(traces), amplitude(-traces)
    return bool(np.mean(down > 2 * np.maximum(up, 0)) > 0.5)


def apart(kev: Values, amplitudes: Values) -> float:
    """Fraction of the pulses whose amplitude does not go with their energy.

    Of a detector and its readout, amplitudes are energies times a gain, but for a few percent
    by trapping, for piled-up and for saturated pulses.  Returns 0 if there are too few, or if
    all amplitudes are alike, as of pulses that were scaled to one height.
    """
    with np.errstate(invalid="ignore"):
        usable = (kev > LOW_KEV) & (amplitudes > 0)
    if usable.sum() < MIN_PULSES:
        return 0.0
    if _far_from_median(amplitudes[usable]) < ALIKE:
        return 0.0
    return _far_from_median(amplitudes[usable] / kev[usable])


def why_apart(kev: Values, amplitudes: Values, traces: Traces) -> tuple[str, str]:
    """Why amplitudes do not go with energies, and what to do.

    They end at one height where something before the digitiser saturates, and are those of
    baselines where records begin with padding.
    """
    with np.errstate(invalid="ignore"):
        usable = (kev > LOW_KEV) & (amplitudes > 0)
    heights, gains = amplitudes[usable], amplitudes[usable] / kev[usable]
    low = heights[gains < (1 - APART) * np.median(gains)]
    if len(low) and _far_from_median(low) < ALIKE:
        top = float(np.quantile(heights, 0.99))
        if np.median(low) > (1 - APART) * top:
            return (
                f"amplitudes end at {top:.0f}, as of a saturated amplifier",
                "select lower energies (`peak`), or another channel",
            )
    padded = float(np.mean(np.ptp(traces[:, : traces.shape[1] // 20], axis=1) == 0))
    if FEW_APART < padded < 1:
        return (
            f"{100 * padded:.0f} % of the traces begin with equal samples, as if padded",
            "leave out these traces, or cut all where their records begin",
        )
    return (
        "these energies are not those of these traces",
        "give the energy column of the same channel and events, in their order",
    )


def _far_from_median(values: Values) -> float:
    return float(np.mean(np.abs(values / np.median(values) - 1) > APART))


@dataclass(frozen=True)
class SecondRate:
    """A change of the rate within a trace: its sample, and how many samples are averaged."""

    sample: int
    averaged: float

    def __str__(self) -> str:
        return (
            f"noise and slope of the tails change at sample {self.sample}, as if "
            f"{self.averaged:.0f} samples were averaged from there: a second rate"
        )


def second_rate(traces: Traces) -> SecondRate | None:
    """Find where digitisers begin to average samples, which are then further apart in time.

    Averages of m samples have less noise, by the root of m if it is white, and the decay goes
    on m times as fast from sample to sample.

    Parameters
    ----------
    traces
        Raw traces, shape (pulses, samples).
    """
    heights = amplitude(traces)
    good = np.isfinite(heights) & (heights > 0)
    if good.sum() < MIN_PULSES:
        return None
    heights = heights[good]
    start = int(np.median(traces[good].argmax(axis=1))) + SMOOTHED
    tail: Values = traces[good, start:].astype(np.float64)
    n = tail.shape[1]
    margin = max(2 * SMOOTHED, round(MARGIN * n))
    if n < 3 * margin:
        return None
    curvature = np.diff(tail, 2, axis=1)
    noise = np.log(np.median(np.abs(curvature), axis=0) + 1e-9)  # (samples,)
    places = np.arange(margin, n - margin)
    sums = np.concatenate([[0.0], np.cumsum(noise)])
    left = sums[places] / places
    right = (sums[-1] - sums[places]) / (len(noise) - places)
    gain = (left - right) ** 2 * places * (len(noise) - places)
    at = int(places[gain.argmax()])
    lower = float(np.exp(left[gain.argmax()] - right[gain.argmax()]))
    baselines = traces[good].max(axis=1) - heights
    level = np.median((tail - baselines[:, np.newaxis]) / heights[:, np.newaxis], axis=0)
    slopes = [
        np.polyfit(np.arange(len(part)), np.log(np.maximum(part, 1e-3)), 1)[0]
        for part in (level[:at], level[at:])
    ]
    faster = slopes[1] / slopes[0] if slopes[0] < 0 else 0.0
    if lower < MIN_NOISE or faster < MIN_SLOPE:
        return None
    return SecondRate(start + at + 1, faster)


log = logging.getLogger(__name__)


MAX_KEV, MIN_KEV = 20_000.0, 20.0  # typical range of gamma energies
# Share of pulses whose amplitude and energy do not go together, from which they are refused,
# and from which a warning tells of it; traces in which a second rate is looked for.
MAX_APART, FEW_APART, RATE_TRACES = 0.2, 0.1, 512
# Shares of traces whose counts roll over: why no pulse is left, and from which all are refused
FEW_ROLLED, MAX_ROLLED = 0.02, 0.2
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
        recorded = recorded_side(source)
        refuse_other_side(recorded, source.path, side, SWAPPED)
        self._guess = recorded is None and not insist
        self._kev, self._amplitudes = list[Values](), list[Values]()
        self._first: npt.NDArray[np.float32] | None = None
        self._ends = list[float]()
        self._baselines = list[Baselines]()
        self._whole, self._rows = list[Pulses](), list[npt.NDArray[np.int64]]()

    @property
    def more_baselines(self) -> bool:
        """Whether further traces are to be prepared for their baselines."""
        return self._side == "measured" and sum(map(len, self._baselines)) < TRACES

    def keep(self, block: Pulses, whole: Prepared | None, usable: Prepared) -> None:
        """Keep what is needed of a block: baselines of all of it, and whole usable pulses."""
        if self._first is None:
            if self._guess:
                found = apparent_side(block.waveforms)
                refuse_other_side(found, self._path, self._side, SWAPPED)
            self._first = block.waveforms[:RATE_TRACES].copy()
        start = sum(map(len, self._kev))  # row of the file of the first pulse
        self._kev.append(block.energy_kev)
        self._amplitudes.append(amplitude(block.waveforms))
        if self._side == "simulated":
            return
        good = block.waveforms[np.isfinite(block.waveforms).all(axis=1)]
        self._ends += [float(good.min()), float(good.max())] if len(good) else []
        if whole is not None:
            like = self._baselines[:1]
            self._baselines.append(Baselines.of_block(block, whole, self._config, *like))
        if (wanted := WHOLE - sum(map(len, self._whole))) > 0:
            self._rows.append(start + usable.index[:wanted])
            self._whole.append(block[usable.index[:wanted]])

    def baselines(self, kept: Prepared) -> Baselines:
        """Baselines, and whole traces of the pulses that are kept."""
        stay = np.isin(np.concatenate(self._rows), kept.index)
        return Baselines.concatenate(self._baselines, Pulses.concatenate(self._whole)[stay])

    @property
    def counts(self) -> tuple[int, int] | None:
        """The lowest and the highest count of whole numbers; None of others."""
        if self._first is None or not self._ends or (self._first != self._first.round()).any():
            return None
        return int(min(self._ends)), int(max(self._ends))

    @property
    def energies_kev(self) -> Values:
        """The known energies."""
        kev: Values = np.concatenate([np.empty(0), *self._kev])
        return kev[np.isfinite(kev)]

    def explained(self, error: CpunetError, selection: EnergySelection) -> CpunetError:
        """Why no pulse can be used, if what was read tells: polarity, energies, calibration."""
        if refusal := self._rolled_over(FEW_ROLLED):
            return refusal
        if self._first is not None and go_down(self._first):
            return CpunetError(
                f"{self._path}: the traces go down: their polarity is negative",
                "invert them, as by pulses.with_waveforms(-pulses.waveforms) in Python",
            )
        known = self.energies_kev
        if len(known):
            none = not selection.select(known).any()
            where = _where_energies_are(known, self._side)
            return CpunetError(f"{error}{where}") if none else error
        found = suggested_calibration(np.concatenate([np.empty(0), *self._amplitudes]))
        if found is None:
            return error
        return CpunetError(f"{error}; their amplitudes look like {found}")

    def _rolled_over(self, share: float) -> CpunetError | None:
        found = None if self._first is None else rolled_over(self._first)
        if found is None or found.share < share:
            return None
        view = "as unsigned (values.view('uint16') in NumPy), or " if found.signed else ""
        return CpunetError(
            f"{self._path}: {found}",
            f"write them {view}as numpy.unwrap(values.astype(float), period={found.period})",
        )

    def require_sense(self) -> None:
        """Refuse counts that roll over, and energies of other pulses; warn of a second rate."""
        if self._insist or self._first is None:
            return
        if refusal := self._rolled_over(MAX_ROLLED):
            raise refusal
        if few := self._rolled_over(0):
            log.warning(str(few))
        kev, amplitudes = np.concatenate(self._kev), np.concatenate(self._amplitudes)
        share = apart(kev, amplitudes)
        told = (
            f"{self._path}: {100 * share:.0f} % of amplitudes and energies do not go together"
        )
        if share > MAX_APART:
            why, remedy = why_apart(kev, amplitudes, self._first)
            raise CpunetError(f"{told}: {why}", remedy)
        if share > FEW_APART:
            log.warning(told)
        if (found := second_rate(self._first)) is not None:
            log.warning(f"{self._path}: {found}; cut the traces there, or resample them")


def _where_energies_are(energies: Values, side: Kind) -> str:
    """Hint on the range of energies in a file of which none is selected."""
    low, middle, high = np.quantile(energies, (0.05, 0.5, 0.95))
    there = f". Energies there: {low:.4g} to {high:.4g} keV, half of them above {middle:.4g}"
    give = "give `kev_per_adc`" if side == "measured" else "multiply them in the file by"
    if high > MAX_KEV and side == "measured":
        return f"{there}: if these are ADC counts, {give}"
    if 0 < high < MIN_KEV:
        return f"{there}: if these are MeV, {give} 1000"
    from_kev = max(np.floor(low / 100) * 100, LOW_KEV)
    n = int((energies >= from_kev).sum())
    if not n:
        return there
    return f"{there}; `peak` {from_kev:.0f}- takes {n} pulses"
