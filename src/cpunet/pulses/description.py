"""What is in a file of pulses: counts, energies, lines, traces, and all in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import label_peaks
from cpunet.pulses.provenance import provenance
from cpunet.pulses.reading.energies import amplitude
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.spectrum import Spectrum, Values, suggested_calibration
from cpunet.recipes.schema import PeakConfig, Recipe
from cpunet.tables import counted, percent, span

BLOCKS, BLOCK = 4, 1024  # number of blocks, traces per block: a few thousand are enough
START = 0.01  # share of the height at which a pulse begins
START_SIGMAS = 5.0  # the same in standard deviations of the noise, if that is more
MIN_BASELINE = 16  # minimum number of samples to estimate the noise
MIN_NUMBER = 10  # minimum number of traces
SHORTEST = 0.05  # share of the traces whose baseline may be shorter than reported


@dataclass(frozen=True)
class TracesInfo:
    """Properties of the traces of a digitiser.

    Parameters
    ----------
    looked_at
        Number of traces.
    trigger_sample
        5, 50 and 95 % quantiles of the sample at half of the height.
    baseline_samples
        Number of samples before nearly all pulses.
    noise_adc, noise_kev
        Median RMS of the baselines; None in keV without known energies.
    decay_us
        Decay time by the median of the tails; None if these do not decay.
    rejected
        Number of traces by reason: the selection of preparation and quality cuts without
        energies.
    saturated_percent, pile_up_percent
        Shares of saturated traces, and of tails that do not fit a decay.
    """

    looked_at: int
    trigger_sample: list[int]
    baseline_samples: int
    noise_adc: float
    noise_kev: float | None
    decay_us: float | None
    rejected: dict[str, int]
    saturated_percent: float
    pile_up_percent: float

    @property
    def lines(self) -> list[tuple[str, str]]:
        """Names and texts."""
        low, middle, high = self.trigger_sample
        noise = f"{self.noise_adc:.3g} ADC"
        if self.noise_kev is not None:
            noise += f", {self.noise_kev:.3g} keV"
        decay = f"{self.decay_us:.3g} µs" if self.decay_us else "the tails do not decay"
        piled = f"{percent(self.pile_up_percent)} (tails that are no single decay)"
        return [
            ("trigger", f"half of the height at sample {middle} (90 % from {low} to {high})"),
            ("baseline", f"{self.baseline_samples} samples before nearly all pulses"),
            ("decay", decay),
            ("noise", f"{noise} (RMS of a baseline, median)"),
            ("saturated", percent(self.saturated_percent)),
            ("pile-up", piled),
            ("left out", f"{counted(self.rejected) or 'none'} of {self.looked_at} traces"),
        ]


def trace_properties(blocks: Iterable[Pulses], recipe: Recipe) -> TracesInfo:
    """Describe the traces of a digitiser.

    Parameters
    ----------
    blocks
        Measured traces of one channel; the first few thousand are used.
    recipe
        Settings of preparation and quality cuts.

    Raises
    ------
    CpunetError
        If too few traces contain a pulse.
    """
    # compiled loops, which a look at plain pulses does not need
    from cpunet.pulses.preparation import Rejection, apply_cuts, fit_cuts, prepare

    whole = Pulses.concatenate(list(islice(blocks, BLOCKS)))
    half, start, noise = _edges(whole)
    with_pulse = np.isfinite(half)
    if with_pulse.sum() < MIN_NUMBER:
        raise CpunetError(f"only {with_pulse.sum()} of {len(half)} traces hold a pulse")
    kev = whole.energy_kev[with_pulse] / amplitude(whole.waveforms[with_pulse])
    known = np.isfinite(kev).sum() >= MIN_NUMBER
    noise_adc, slope = float(np.nanmedian(noise)), 0.0
    prepared = prepare(whole, recipe.preparation, "measured")
    if len(prepared) >= MIN_NUMBER:
        slope = float(np.median(prepared.tail_slope))
        prepared = apply_cuts(prepared, fit_cuts(prepared, recipe.cuts))
    reasons = prepared.rejections
    piled = sum(reasons.get(r.label, 0) for r in (Rejection.TAIL_SLOPE, Rejection.CHI2))
    return TracesInfo(
        looked_at=len(half),
        trigger_sample=[round(float(q)) for q in np.nanquantile(half, (0.05, 0.5, 0.95))],
        baseline_samples=int(np.nanquantile(start, SHORTEST)),
        noise_adc=noise_adc,
        noise_kev=noise_adc * float(np.nanmedian(kev)) if known else None,
        decay_us=-1e3 / slope if slope < 0 else None,
        rejected=reasons,
        saturated_percent=100 * reasons.get(Rejection.SATURATED.label, 0) / len(half),
        pile_up_percent=100 * piled / len(half),
    )


def _edges(block: Pulses) -> tuple[Values, Values, Values]:
    """Sample at half of the height, first sample of the pulse, RMS of the baseline before it.

    NaN where a trace has no pulse; shape ``(n,)`` each.
    """
    from cpunet.pulses.parameters import last_below  # compiled loops

    waveforms = np.asarray(block.waveforms, np.float32)
    few = max(MIN_BASELINE, waveforms.shape[1] // 20)
    with np.errstate(invalid="ignore", over="ignore"):
        baseline = waveforms[:, :few].mean(axis=1)
        top = waveforms.argmax(axis=1)
        height = waveforms.max(axis=1) - baseline
        rms = waveforms[:, :few].std(axis=1)
        pulse = np.isfinite(height) & (height > START_SIGMAS * rms) & (top > 0)
        half, start = (
            np.where(*last_below(waveforms, top, baseline + level), -1) + 1
            for level in (height / 2, np.maximum(START * height, START_SIGMAS * rms))
        )
    return tuple(np.where(pulse, v, np.nan).astype(float) for v in (half, start, rms))  # type: ignore[return-value]


@dataclass(frozen=True)
class PulsesInfo:
    """What is known of the pulses of one table.

    Parameters
    ----------
    path, format, table, columns, length, dt_ns, energy
        File, and what it says before any pulse is read.
    n_pulses
        Number of pulses.
    energy_kev, n_without_energy
        Lowest and highest energy (None if unknown), and number of pulses without one.
    peaks
        Number of pulses by line.
    found
        Source whose lines are there, and at which share of their energies.
    amplitudes
        A suggested calibration, if no energy is known.
    samples
        Lowest and highest value of the finite traces.
    n_not_finite, n_constant
        Numbers of such traces.
    provenance
        How they were made, if the file records it.
    """

    path: str
    format: str
    table: str
    columns: list[str]
    length: int
    dt_ns: float
    energy: str
    n_pulses: int
    energy_kev: list[float] | None
    n_without_energy: int
    peaks: dict[str, int]
    found: str
    amplitudes: str
    samples: list[float] | None
    n_not_finite: int
    n_constant: int
    provenance: dict[str, str]

    @property
    def lines(self) -> list[tuple[str, str]]:
        """Names and texts."""
        energy = self.energy
        if self.energy_kev:
            energy += f", {span(self.energy_kev)} keV"
            if self.n_without_energy:
                energy += f"; {self.n_without_energy} pulses have none"
        odd = {"not finite": self.n_not_finite, "constant": self.n_constant}
        odds = "".join(f"; {n} traces {what}" for what, n in odd.items() if n)
        size = f"{self.n_pulses} of {self.length} samples, every {self.dt_ns:g} ns"
        return [
            ("file", self.path),
            ("format", f"{self.format}, table {self.table}"),
            ("traces", size),
            ("columns", ", ".join(self.columns)),
            *self.provenance.items(),
            ("energy", energy),
            ("lines", counted(self.peaks)),
            ("source", self.found),
            ("amplitudes", self.amplitudes),
            ("samples", f"values {span(self.samples)}{odds}"),
        ]


def describe_pulses(
    source: PulseSource, peaks: Mapping[str, PeakConfig]
) -> tuple[PulsesInfo, Spectrum]:
    """Describe the pulses of one table; also return their spectrum.

    The file is read in blocks; only energies or amplitudes of all pulses are held in memory.

    Parameters
    ----------
    source
        The opened file.
    peaks
        Gamma lines to count.

    Returns
    -------
    PulsesInfo
        What is known.
    Spectrum
        Energies, or amplitudes if no energy is known, with the lines found.
    """
    energies, heights, extremes = [], [], [np.empty(0)]
    n_pulses = n_not_finite = n_constant = 0
    for block in source.blocks():
        n_pulses += len(block)
        energies.append(known := block.energy_kev[np.isfinite(block.energy_kev)])
        if not len(known):
            heights.append(amplitude(block.waveforms))
        # A sum is NaN or infinite if any sample is; this needs no mask as large as the block.
        with np.errstate(invalid="ignore", over="ignore"):
            finite = np.isfinite(block.waveforms.sum(axis=1, dtype=np.float64))
        n_not_finite += int((~finite).sum())
        good = block.waveforms if finite.all() else block.waveforms[finite]
        low, high = good.min(axis=1), good.max(axis=1)
        n_constant += int((low == high).sum())
        extremes += [low, high]
    kev, samples = np.concatenate(energies), np.concatenate(extremes)
    values = kev if len(kev) else np.concatenate(heights)
    spectrum = Spectrum(values, in_kev=len(kev) > 0, found=suggested_calibration(values))
    found, amplitudes, lines = spectrum.found, "", label_peaks(kev, peaks)
    if not spectrum.in_kev:
        amplitudes = "no lines that stand out" if found is None else f"like {found}"
    elif found is not None:
        place = f"{1 / found.kev_per_adc:.4f} of their energies"
    layout = source.layout
    told = PulsesInfo(
        path=str(source.path),
        format=layout.format,
        table=layout.table,
        columns=sorted(layout.columns),
        length=source.length,
        dt_ns=source.dt_ns,
        energy=source.energies.description,
        n_pulses=n_pulses,
        energy_kev=_ends(kev),
        n_without_energy=n_pulses - len(kev),
        peaks={name: int((lines == name).sum()) for name in peaks},
        found=f"lines of {found.source}, at {place}" if found and spectrum.in_kev else "",
        amplitudes=amplitudes,
        samples=_ends(samples),
        n_not_finite=n_not_finite,
        n_constant=n_constant,
        provenance=provenance(source),
    )
    return told, spectrum


def _ends(values: npt.NDArray[Any]) -> list[float] | None:
    return [float(values.min()), float(values.max())] if len(values) else None
