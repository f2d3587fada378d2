"""Gather and check what is needed of raw traces to measure remains of earlier pulses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_tails import MIN_N, SHORTEST_SHARE, samples_before_pulses
from cpunet.electronics.exponentials import FloatArray
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import Prepared, prepare
from cpunet.recipes.schema import PreparationConfig

MIN_SAMPLES = 64  # minimum length of a baseline


@dataclass(frozen=True, eq=False)
class Gathered:
    """First samples and scalar properties of the traces."""

    baselines: FloatArray
    energy_kev: FloatArray
    adc_per_kev: float
    tail_decay_us: float
    dt_ns: float


def gathered(blocks: Iterable[Pulses], config: PreparationConfig, most: int) -> Gathered:
    """Read blocks until there are enough traces."""
    baselines: list[npt.NDArray[np.float32]] = []
    energies, heights, scales, slopes = [], [], [], []
    samples, dt_ns = 0, 0.0
    for raw in blocks:
        prepared = prepare(raw, config, "measured")
        samples = samples or _length(raw, prepared, config)
        dt_ns = raw.dt_ns
        baselines.append(np.array(raw.waveforms[:, :samples]))
        energies.append(raw.energy_kev)
        height = prepared.pulses.waveforms.max(axis=1) * prepared.scale
        with np.errstate(divide="ignore"):  # an energy of 0 is left out by `_gain`
            heights.append(height / prepared.pulses.energy_kev)
        scales.append(prepared.scale)
        slopes.append(prepared.tail_slope)
        if sum(map(len, baselines)) >= most:
            break
    if not baselines:
        raise CpunetError("there are no traces to tell remains of earlier pulses from")
    scale, slope = np.concatenate(scales), np.concatenate(slopes)
    return Gathered(
        np.concatenate(baselines).astype(float),
        np.concatenate(energies),
        _gain(np.concatenate(heights)),
        _tail_decay_us(slope[scale >= np.median(scale)]),
        dt_ns,
    )


def _length(raw: Pulses, prepared: Prepared, config: PreparationConfig) -> int:
    """Number of initial samples that precede nearly all pulses."""
    if len(prepared) < MIN_N:
        raise CpunetError(
            f"only {len(prepared)} of {len(raw)} traces can be prepared "
            f"({_reasons(prepared)}); {MIN_N} or more are needed to tell remains of earlier "
            "pulses"
        )
    free = samples_before_pulses(prepared, config)
    length = int(np.quantile(free, SHORTEST_SHARE))
    if length < MIN_SAMPLES:
        raise CpunetError(
            f"the traces have {max(length, 0)} samples before the pulse; remains of earlier "
            f"pulses need {MIN_SAMPLES} or more, so give traces with a longer baseline"
        )
    return length


def _reasons(prepared: Prepared) -> str:
    """Counts of the reasons why traces cannot be prepared."""
    told = [f"{n} {reason}" for reason, n in prepared.rejections.items()]
    return ", ".join(told) or "there are no more"


def _gain(ratios: FloatArray) -> float:
    """Gain in ADC counts per keV from the heights of the pulses."""
    known = ratios[np.isfinite(ratios) & (ratios > 0)]
    if len(known) < MIN_N:
        raise CpunetError(
            f"only {len(known)} traces have a known energy and can be prepared; {MIN_N} or "
            "more are needed to tell remains of earlier pulses in keV"
        )
    return float(np.median(known))


def _tail_decay_us(slopes: FloatArray) -> float:
    """Decay time in us of the tails of pulses."""
    slope = float(np.median(slopes))
    if not slope < 0:
        raise CpunetError(
            "the tails of the traces do not decay, so nothing is known of earlier pulses; "
            "are these measured traces?"
        )
    return -1e3 / slope
