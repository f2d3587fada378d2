"""Trigger, baseline, decay, noise, saturation and pile-up of measured traces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.cuts import apply_cuts, fit_cuts
from cpunet.pulses.preparation import Prepared, Rejection, prepare
from cpunet.pulses.reading.energies import amplitude
from cpunet.recipes.schema import Recipe
from cpunet.tables import counted, percent

BLOCKS, BLOCK = 4, 1024  # number of blocks, traces per block: a few thousand are enough
START = 0.01  # share of the height at which a pulse begins
START_SIGMAS = 5.0  # the same in standard deviations of the noise, if that is more
MIN_BASELINE = 16  # minimum number of samples to estimate the noise
MIN_NUMBER = 10  # minimum number of traces
SHORTEST = 0.05  # share of the traces whose baseline may be shorter than reported

Values = npt.NDArray[np.float64]


def trace_properties(blocks: Iterable[Pulses], recipe: Recipe) -> dict[str, Any]:
    """Describe the traces of a digitiser.

    Parameters
    ----------
    blocks
        Measured traces of one channel; the first few thousand are used.
    recipe
        Settings of preparation and quality cuts.

    Returns
    -------
    dict
        ``looked_at`` (number of traces); ``trigger_sample`` (5, 50 and 95 % quantiles of the
        sample at half of the height); ``baseline_samples`` (before nearly all pulses);
        ``noise_adc`` and, with known energies, ``noise_kev`` (median RMS of the baselines);
        ``decay_us`` (median of the tails); ``rejected`` (number of traces by reason: the
        selection of preparation and quality cuts without energies), with ``saturated`` and
        ``pile_up`` (tails that do not fit a decay) also as shares in percent.

    Raises
    ------
    CpunetError
        If too few traces contain a pulse.
    """
    seen = list(islice(blocks, BLOCKS))
    found = [_edges(block) for block in seen]
    half, start, noise = (np.concatenate(part) for part in zip(*found, strict=True))
    with_pulse = np.isfinite(half)
    if with_pulse.sum() < MIN_NUMBER:
        raise CpunetError(f"only {with_pulse.sum()} of {len(half)} traces hold a pulse")
    told: dict[str, Any] = {
        "looked_at": len(half),
        "trigger_sample": [round(float(q)) for q in np.nanquantile(half, (0.05, 0.5, 0.95))],
        "baseline_samples": int(np.nanquantile(start, SHORTEST)),
        "noise_adc": float(np.nanmedian(noise)),
    }
    kev = np.concatenate([block.energy_kev for block in seen])[with_pulse]
    kev /= np.concatenate([amplitude(block.waveforms) for block in seen])[with_pulse]
    if np.isfinite(kev).sum() >= MIN_NUMBER:
        told["noise_kev"] = told["noise_adc"] * float(np.nanmedian(kev))
    prepared = Prepared.concatenate([prepare(b, recipe.preparation, "measured") for b in seen])
    if len(prepared) >= MIN_NUMBER:
        slope = float(np.median(prepared.tail_slope))
        if slope < 0:
            told["decay_us"] = -1e3 / slope
        prepared = apply_cuts(prepared, fit_cuts(prepared, recipe.cuts))
    reasons = prepared.rejections
    piled = sum(reasons.get(r.label, 0) for r in (Rejection.TAIL_SLOPE, Rejection.CHI2))
    return told | {
        "rejected": reasons,
        "saturated_percent": 100 * reasons.get(Rejection.SATURATED.label, 0) / len(half),
        "pile_up_percent": 100 * piled / len(half),
    }


def traces_in_words(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and texts for the result of `trace_properties`."""
    low, middle, high = told["trigger_sample"]
    noise = f"{told['noise_adc']:.3g} ADC"
    if "noise_kev" in told:
        noise += f", {told['noise_kev']:.3g} keV"
    decay = told.get("decay_us")
    return [
        ("trigger", f"half of the height at sample {middle} (90 % from {low} to {high})"),
        ("baseline", f"{told['baseline_samples']} samples before nearly all pulses"),
        ("decay", f"{decay:.3g} µs" if decay else "the tails do not decay"),
        ("noise", f"{noise} (RMS of a baseline, median)"),
        ("saturated", percent(told["saturated_percent"])),
        ("pile-up", f"{percent(told['pile_up_percent'])} (tails that are no single decay)"),
        ("left out", f"{counted(told['rejected']) or 'none'} of {told['looked_at']} traces"),
    ]


def _edges(block: Pulses) -> tuple[Values, Values, Values]:
    """Sample at half of the height, first sample of the pulse, RMS of the baseline before it.

    NaN where a trace has no pulse; shape ``(n,)`` each.
    """
    waveforms = np.asarray(block.waveforms, np.float32)
    few = max(MIN_BASELINE, waveforms.shape[1] // 20)
    with np.errstate(invalid="ignore", over="ignore"):
        baseline = waveforms[:, :few].mean(axis=1)
        top = waveforms.argmax(axis=1)
        height = waveforms.max(axis=1) - baseline
        rms = waveforms[:, :few].std(axis=1)
        pulse = np.isfinite(height) & (height > START_SIGMAS * rms) & (top > 0)
        half = _last_below(waveforms, top, baseline + height / 2)
        level = np.maximum(START * height, START_SIGMAS * rms)
        start = _last_below(waveforms, top, baseline + level)
    return tuple(np.where(pulse, v, np.nan).astype(float) for v in (half, start, rms))  # type: ignore[return-value]


def _last_below(
    waveforms: npt.NDArray[np.float32], top: npt.NDArray[np.intp], level: npt.NDArray[Any]
) -> npt.NDArray[np.intp]:
    """Number of samples up to the last one below a level before the maximum."""
    below = waveforms < level[:, np.newaxis]
    below &= np.arange(waveforms.shape[1]) < top[:, np.newaxis]
    samples = waveforms.shape[1] - below[:, ::-1].argmax(axis=1)
    return np.where(below.any(axis=1), samples, 0)
