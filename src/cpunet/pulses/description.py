"""What is in a file of pulses, in words: counts, energies, lines, traces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.peaks import label_peaks
from cpunet.pulses.provenance import provenance
from cpunet.pulses.reading.energies import amplitude
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.spectrum import suggested_calibration
from cpunet.recipes.schema import PeakConfig, PreparationConfig, Recipe
from cpunet.tables import counted, span

MIN_SIGMAS = 5.0  # least height of a pulse in standard deviations of the noise
MIN_BASELINE = 16  # minimum number of samples to estimate the noise
MIN_NUMBER = 10  # minimum number of traces
# Counts that roll over: least period and number of traces, and share of the steep ones
LEAST_PERIOD, MIN_ROLLED, MOSTLY = 256, 3, 0.9

Words = list[tuple[str, str]]


def trace_properties(whole: Pulses, config: PreparationConfig) -> Words:
    """Describe the traces of a digitiser.

    Parameters
    ----------
    whole
        Measured traces of one channel.
    config
        Preparation settings.

    Returns
    -------
    list
        Names and texts: decay time by the median of the tails, and median RMS of the baselines.

    Raises
    ------
    CpunetError
        If too few traces contain a pulse.
    """
    first = whole.waveforms[:, : max(MIN_BASELINE, whole.length // 20)]
    with np.errstate(invalid="ignore", over="ignore"):
        height, rms = whole.waveforms.max(axis=1) - first.mean(axis=1), first.std(axis=1)
        is_pulse = np.isfinite(height) & (height > MIN_SIGMAS * rms)
    if is_pulse.sum() < MIN_NUMBER:
        raise CpunetError(f"only {is_pulse.sum()} of {len(whole)} traces hold a pulse")
    traces, noise_adc = whole.waveforms[is_pulse], float(np.median(rms[is_pulse].astype(float)))
    noise = f"{noise_adc:.3g} ADC"
    kev_per_adc = whole.energy_kev[is_pulse] / amplitude(traces)
    if np.isfinite(kev_per_adc).sum() >= MIN_NUMBER:
        noise += f", {noise_adc * float(np.nanmedian(kev_per_adc)):.3g} keV"
    slope = _tail_slope(traces, config.at(whole.dt_ns)) * 1e3 / whole.dt_ns
    return [
        ("decay", f"{-1 / slope:.3g} µs" if slope < 0 else "the tails do not decay"),
        ("noise", f"{noise} (RMS of a baseline, median)"),
    ]


def _tail_slope(traces: FloatArray, config: PreparationConfig) -> float:
    """Slope per sample of the logarithm of the tails, median; 0 if there are few."""
    # where a window has them, but without its compiled loops, which load in a second
    top = traces.argmax(axis=1)
    known = (top >= config.samples_before) & (top + config.samples_after <= traces.shape[1])
    start = top[known, np.newaxis] - config.samples_before
    windows = np.take_along_axis(traces[known], start + np.arange(config.length), axis=1)
    tails = windows[:, -config.decay_fit_samples :].astype(float)
    tails -= windows[:, : config.baseline_samples].mean(axis=1, keepdims=True, dtype=float)
    tails = tails[tails.min(axis=1) > 0]
    lever = np.arange(tails.shape[1]) - (tails.shape[1] - 1) / 2
    slopes = np.log(tails) @ lever / (lever @ lever)
    return float(np.median(slopes)) if len(slopes) >= MIN_NUMBER else 0.0


def rolled_over(traces: FloatArray) -> RolledOver | None:
    """Find counts that jump by a power of two, where nothing else rises within a sample.

    Parameters
    ----------
    traces
        Raw traces, shape (pulses, samples).

    Examples
    --------
    >>> ramp = 30_000 + 50.0 * np.arange(200) + np.arange(5)[:, np.newaxis]
    >>> rolled_over(ramp) is None, rolled_over((ramp + 2**15) % 2**16 - 2**15)
    (True, RolledOver(period=65536, share=1.0, signed=True))
    """
    jumps = np.abs(np.diff(traces, axis=1)).max(axis=1)
    steep = (jumps > np.ptp(traces, axis=1) / 2) & (jumps >= LEAST_PERIOD / 2)
    if steep.sum() < MIN_ROLLED or (traces[steep] != np.round(traces[steep])).any():
        return None
    period = 2 ** int(np.round(np.log2(np.median(jumps[steep]))))
    left = np.abs(np.diff(np.unwrap(traces[steep], period=period), axis=1)).max(axis=1)
    rolled = (np.abs(jumps[steep] - period) < period / 4) & (left < period / 4)
    signed = period == 2**16 and bool(traces[steep].min() < 0)
    return RolledOver(period, float(steep.mean()), signed) if rolled.mean() > MOSTLY else None


@dataclass(frozen=True)
class RolledOver:
    """Counts that jump by a period, the share of traces in which they do, and their type."""

    period: int
    share: float
    signed: bool

    def __str__(self) -> str:
        return (
            f"{100 * self.share:.0f} % of the traces jump by {self.period} = "
            f"2^{self.period.bit_length() - 1} counts: "
            + ("unsigned samples stored as signed, or " if self.signed else "")
            + "counts beyond the range rolled over"
        )


def left_out(whole: Pulses, recipe: Recipe) -> str:
    """What preparation and quality cuts of a recipe leave out of measured traces, and why."""
    # compiled loops, which a look at pulses does not need
    from cpunet.pulses.preparation import apply_cuts, fit_cuts, prepare

    prepared = prepare(whole, recipe.preparation, "measured")
    if len(prepared) >= MIN_NUMBER:
        prepared = apply_cuts(prepared, fit_cuts(prepared, recipe.cuts))
    return f"{counted(prepared.rejections) or 'none'} of {len(whole)} traces"


def describe_pulses(
    source: PulseSource, blocks: Iterable[Pulses], peaks: Mapping[str, PeakConfig]
) -> Words:
    """Describe the pulses of one table, by names and texts.

    The file is read in blocks; only energies or amplitudes of all pulses are held in memory.

    Parameters
    ----------
    source
        The opened file.
    blocks
        Its pulses.
    peaks
        Gamma lines to count.
    """
    energies, heights, extremes = [], [], [np.empty(0)]
    n_pulses = n_not_finite = n_constant = n_copies = 0
    seen = set[int]()
    for block in blocks:
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
        hashes = [hash(trace.tobytes()) for trace in good[low < high]]
        n_copies += len(hashes) - len({*hashes} - seen)
        seen.update(hashes)
        extremes += [low, high]
    kev, samples = np.concatenate(energies), np.concatenate(extremes)
    found = suggested_calibration(kev if len(kev) else np.concatenate(heights))
    energy, origin, amplitudes = source.energies.description, "", ""
    if len(kev):
        energy += f", {span([kev.min(), kev.max()])} keV"
        energy += f"; {n_pulses - len(kev)} pulses have none" if len(kev) < n_pulses else ""
        if found is not None:
            place = f"{1 / found.kev_per_adc:.4f} of their energies"
            origin = f"lines of {found.source}, at {place}"
    else:
        amplitudes = "no lines that stand out" if found is None else f"like {found}"
    lines, odd = label_peaks(kev, peaks), {"not finite": n_not_finite, "constant": n_constant}
    odd["copies of others"] = n_copies
    odds = "".join(f"; {n} traces {what}" for what, n in odd.items() if n)
    ends = [samples.min(), samples.max()] if len(samples) else None
    return [
        ("file", str(source.path)),
        ("format", f"{source.table.format}, table {source.table.name}"),
        ("traces", f"{n_pulses} of {source.length} samples, every {source.dt_ns:g} ns"),
        ("columns", ", ".join(sorted(source.columns))),
        *provenance(source).items(),
        ("energy", energy),
        ("lines", counted({name: int((lines == name).sum()) for name in peaks})),
        ("source", origin),
        ("amplitudes", amplitudes),
        ("samples", f"values {span(ends)}{odds}"),
    ]
