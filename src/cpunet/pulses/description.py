"""What is in a file of pulses, in words: counts, energies, lines, traces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses, line_slope
from cpunet.pulses.peaks import label_peaks, suggested_calibration
from cpunet.pulses.provenance import provenance
from cpunet.pulses.reading.source import PulseSource, amplitude
from cpunet.recipes.schema import PeakConfig, PreparationConfig, Recipe
from cpunet.tables import counted, span

MIN_SIGMAS = 5.0  # least height of a pulse in standard deviations of the noise
MIN_BASELINE = 16  # minimum number of samples to estimate the noise
MIN_NUMBER = 10  # minimum number of traces

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
    # tails where a window has them, but without its compiled loops, which load in a second
    config, top = config.at(whole.dt_ns), traces.argmax(axis=1)
    inside = (top >= config.samples_before) & (top + config.samples_after <= whole.length)
    start = top[inside, np.newaxis] - config.samples_before
    windows = np.take_along_axis(traces[inside], start + np.arange(config.length), axis=1)
    tails = windows[:, -config.decay_fit_samples :].astype(float)
    tails -= windows[:, : config.baseline_samples].mean(axis=1, keepdims=True, dtype=float)
    tails, slope = tails[tails.min(axis=1) > 0], 0.0
    if len(tails) >= MIN_NUMBER:
        slopes = np.log(tails) @ line_slope(tails.shape[1])
        slope = float(np.median(slopes)) * 1e3 / whole.dt_ns
    return [
        ("decay", f"{-1 / slope:.3g} µs" if slope < 0 else "the tails do not decay"),
        ("noise", f"{noise} (RMS of a baseline, median)"),
    ]


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
        energies.append(of_block := block.energy_kev[np.isfinite(block.energy_kev)])
        if not len(of_block):
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
    lines_at = suggested_calibration(kev if len(kev) else np.concatenate(heights))
    energy, origin, amplitudes = source.energies, "", ""
    if len(kev):
        energy += f", {span([kev.min(), kev.max()])} keV"
        energy += f"; {n_pulses - len(kev)} pulses have none" if len(kev) < n_pulses else ""
        if lines_at is not None:
            place = f"{1 / lines_at.kev_per_adc:.4f} of their energies"
            origin = f"lines of {lines_at.source}, at {place}"
    else:
        amplitudes = "no lines that stand out" if lines_at is None else f"like {lines_at}"
    lines, odd = label_peaks(kev, peaks), {"not finite": n_not_finite, "constant": n_constant}
    odd["copies of others"] = n_copies
    odds = "".join(f"; {n} traces {what}" for what, n in odd.items() if n)
    ends = [samples.min(), samples.max()] if len(samples) else None
    return [
        ("file", str(source.path)),
        ("format", f"{source.format}, table {source.name}"),
        ("traces", f"{n_pulses} of {source.length} samples, every {source.dt_ns:g} ns"),
        ("columns", ", ".join(sorted(source.columns))),
        *provenance(source).items(),
        ("energy", energy),
        ("lines", counted({name: int((lines == name).sum()) for name in peaks})),
        ("source", origin),
        ("amplitudes", amplitudes),
        ("samples", f"values {span(ends)}{odds}"),
    ]
