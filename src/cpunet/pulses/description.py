"""What is in a file of pulses, in words: counts, energies, lines, traces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice

import numpy as np

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.peaks import label_peaks
from cpunet.pulses.provenance import provenance
from cpunet.pulses.reading.energies import amplitude
from cpunet.pulses.reading.source import PulseSource
from cpunet.pulses.spectrum import suggested_calibration
from cpunet.recipes.schema import PeakConfig, Recipe
from cpunet.tables import counted, span

BLOCKS, BLOCK = 4, 1024  # number of blocks, traces per block: a few thousand are enough
MIN_SIGMAS = 5.0  # least height of a pulse in standard deviations of the noise
MIN_BASELINE = 16  # minimum number of samples to estimate the noise
MIN_NUMBER = 10  # minimum number of traces

Words = list[tuple[str, str]]


def trace_properties(blocks: Iterable[Pulses], recipe: Recipe) -> Words:
    """Describe the traces of a digitiser.

    Parameters
    ----------
    blocks
        Measured traces of one channel; the first few thousand are used.
    recipe
        Settings of preparation and quality cuts.

    Returns
    -------
    list
        Names and texts: decay time by the median of the tails, median RMS of the baselines,
        and what preparation and quality cuts leave out.

    Raises
    ------
    CpunetError
        If too few traces contain a pulse.
    """
    # compiled loops, which a look at plain pulses does not need
    from cpunet.pulses.preparation import apply_cuts, fit_cuts, prepare

    whole = Pulses.concatenate(list(islice(blocks, BLOCKS)))
    first = whole.waveforms[:, : max(MIN_BASELINE, whole.length // 20)]
    with np.errstate(invalid="ignore", over="ignore"):
        height, rms = whole.waveforms.max(axis=1) - first.mean(axis=1), first.std(axis=1)
        is_pulse = np.isfinite(height) & (height > MIN_SIGMAS * rms)
    if is_pulse.sum() < MIN_NUMBER:
        raise CpunetError(f"only {is_pulse.sum()} of {len(whole)} traces hold a pulse")
    noise_adc = float(np.median(rms[is_pulse].astype(float)))
    noise = f"{noise_adc:.3g} ADC"
    kev_per_adc = whole.energy_kev[is_pulse] / amplitude(whole.waveforms[is_pulse])
    if np.isfinite(kev_per_adc).sum() >= MIN_NUMBER:
        noise += f", {noise_adc * float(np.nanmedian(kev_per_adc)):.3g} keV"
    prepared, slope = prepare(whole, recipe.preparation, "measured"), 0.0
    if len(prepared) >= MIN_NUMBER:
        slope = float(np.median(prepared.tail_slope))
        prepared = apply_cuts(prepared, fit_cuts(prepared, recipe.cuts))
    left_out = counted(prepared.rejections) or "none"
    return [
        ("decay", f"{-1e3 / slope:.3g} µs" if slope < 0 else "the tails do not decay"),
        ("noise", f"{noise} (RMS of a baseline, median)"),
        ("left out", f"{left_out} of {len(whole)} traces"),
    ]


def describe_pulses(source: PulseSource, peaks: Mapping[str, PeakConfig]) -> Words:
    """Describe the pulses of one table, by names and texts.

    The file is read in blocks; only energies or amplitudes of all pulses are held in memory.

    Parameters
    ----------
    source
        The opened file.
    peaks
        Gamma lines to count.
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
    odds = "".join(f"; {n} traces {what}" for what, n in odd.items() if n)
    ends = [samples.min(), samples.max()] if len(samples) else None
    return [
        ("file", str(source.path)),
        ("format", f"{source.layout.format}, table {source.layout.table}"),
        ("traces", f"{n_pulses} of {source.length} samples, every {source.dt_ns:g} ns"),
        ("columns", ", ".join(sorted(source.columns))),
        *provenance(source).items(),
        ("energy", energy),
        ("lines", counted({name: int((lines == name).sum()) for name in peaks})),
        ("source", origin),
        ("amplitudes", amplitudes),
        ("samples", f"values {span(ends)}{odds}"),
    ]
