"""Noise and pile-up tails of the measured side."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_pile_up import SIZES_KEV, DrawnTails, tail_shape
from cpunet.electronics.finishing import padding
from cpunet.electronics.pile_up_tails import PileUpTails, TailsInfo
from cpunet.errors import CpunetError
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import InputSet
from cpunet.pulses.preparation import CutWindows, apply_cuts, prepare
from cpunet.recipes.schema import PreparationConfig
from cpunet.settings import plain
from cpunet.tables import with_std

log = logging.getLogger(__name__)

NOISE_TRACES = 4096  # number of traces whose baselines determine the noise
MIN_EMPTY = 200  # minimum number of these if traces with tails are left out
TEMPLATES, MIN_TEMPLATES = 150, 20  # traces to which tails are added


def trace_noise(data: InputSet, config: PreparationConfig) -> tuple[BaselineNoise, TailsInfo]:
    """Measure noise and pile-up tails in the data of a training, and note the result.

    Parameters
    ----------
    data
        Measured pulses that passed the cuts, with the baselines of their file.
    config
        Preparation of the pulses.

    Returns
    -------
    tuple
        Noise, with tails to draw if their existence is certain; entry of ``run.json``: what was
        measured of tails, even if it is not.

    Raises
    ------
    CpunetError
        If there are too few flat baselines.
    """
    pile_up, reason = tails_of(data)
    noise, dt_ns, passed = noise_of(data, pile_up), data.dt_ns, None
    if pile_up is None:
        log.info(f"pile-up tails are not measured: {reason}")
        return noise, TailsInfo(missing=reason)
    # tails to draw like those of the data behind their quality cuts
    assert data.baselines is not None  # of which the tails are
    law, whole = pile_up.law, data.baselines.whole
    if data.cuts is not None and whole is not None and law is not None:
        passed = passing(pile_up, whole, config, data.cuts)
    before = config.at(dt_ns).samples_before + padding(dt_ns)[0]
    lead_us = (float(np.median(data.prepared.align_sample)) - before) * dt_ns * 1e-3
    height = float(np.median(data.prepared.pulses.waveforms.max(axis=1)))
    of_windows = {"height": height, "lead_us": lead_us, "dt_ns": dt_ns, "passed": passed}
    drawn = DrawnTails(**asdict(pile_up.fit.law) | of_windows)
    info = pile_up.describe().model_copy(update={"drawn": plain(asdict(drawn))})
    if law is None:
        return noise, info
    slopes = " (by slopes alone: levels do not follow the tilts)"
    log.info(
        f"pile-up tails: {with_std(info.rate_khz, info.rate_error_khz)} kHz"
        f"{'' if pile_up.level_weight else slopes}, "
        f"{info.percent_above['10_kev']['law']:.2g} % of the traces above 10 keV; "
        "translations are given them"
    )
    return replace(noise, tails=drawn), info


def passing(
    tails: PileUpTails, traces: Pulses, config: PreparationConfig, cuts: CutWindows
) -> tuple[float, ...] | None:
    """Probability that traces with tails of `SIZES_KEV` pass the quality cuts.

    Parameters
    ----------
    tails
        Tails of the channel.
    traces
        Raw traces that have passed the cuts.
    config, cuts
        Preparation settings and quality cuts.

    Returns
    -------
    tuple of float
        One probability per size, or None if too few traces have no tail.
    """
    raw = traces.waveforms[tails.measure(traces) < tails.fit.sigma_kev][:TEMPLATES]
    if len(raw) < MIN_TEMPLATES:
        return None
    shape = tail_shape(raw.shape[1], tails.dt_ns, tails.decay_us)
    unit, shares = (tails.adc_per_kev * shape).astype(np.float32), []
    for kev in SIZES_KEV:
        lifted = Pulses.of(raw + np.float32(kev) * unit, dt_ns=tails.dt_ns)
        shares.append(len(apply_cuts(prepare(lifted, config, "measured"), cuts)) / len(raw))
    return tuple(share / max(shares[0], 1e-9) for share in np.minimum.accumulate(shares))


def tails_of(data: InputSet) -> tuple[PileUpTails | None, str | None]:
    """Pile-up tails of the data and None, or None and why they cannot be estimated."""
    assert data.baselines is not None  # these are measured pulses
    try:
        return PileUpTails.of(data.baselines), None
    except CpunetError as error:
        return None, str(error)


def noise_of(data: InputSet, tails: PileUpTails | None = None) -> BaselineNoise:
    """Measure the noise from the raw samples before the pulses.

    If traces have pile-up tails, only those at the level of empty baselines are used.

    Raises
    ------
    CpunetError
        If the baselines are too few or too short.
    """
    assert data.baselines is not None  # these are measured pulses
    first = data.baselines.first
    usable = np.isfinite(first.energy_kev) & (first.energy_kev > 0)
    usable[NOISE_TRACES:] = False
    if tails is not None and tails.law is not None:
        empty = usable & tails.empty(first)
        usable = empty if empty.sum() >= MIN_EMPTY else usable
    return BaselineNoise.of(data.baselines, usable)
