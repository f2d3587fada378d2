"""Records of pulses: windows with room around them, and back to windows prepared like the data.

A window is extended with baseline before it and its own decay after it, so that it can be cut
anew once noise is added.

Noise and pile-up tails of the measured side.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_pile_up import DrawnTails, TraceNoise, passing
from cpunet.electronics.pile_up_tails import PileUpTails, TailsInfo
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses, blocks
from cpunet.pulses.loading import InputSet
from cpunet.pulses.parameters import tail_slope
from cpunet.pulses.preparation import Baselines, Codes, prepare
from cpunet.recipes.schema import PreparationConfig

# Padding before and after a window in ns, so that it can be cut anew and delayed pulses stay
# within the record. A window of 800 samples of 16 ns becomes a record of 1400, a fast length of
# the FFT.
PADDING_NS = 3200.0, 6400.0


def padding(dt_ns: float) -> tuple[int, int]:
    """Samples of padding before and after a window."""
    before, after = PADDING_NS
    return round(before / dt_ns), round(after / dt_ns)


def record_length(window: int, dt_ns: float) -> int:
    """Number of samples of the record that a window of `window` samples becomes."""
    return window + sum(padding(dt_ns))


def extended(
    windows: FloatArray, config: PreparationConfig, dt_ns: float, length: int, n_pre: int
) -> FloatArray:
    """Cut or extend prepared windows, with 0 before them and their fitted decay after them.

    Parameters
    ----------
    windows
        Shape (n, config.length); a row with a NaN becomes NaN.
    config
        Their preparation settings. The last `decay_fit_samples` of each determine its decay.
    dt_ns
        Sampling period in ns.
    length, n_pre
        Number of samples of the result, and number of samples before the alignment.

    Returns
    -------
    numpy.ndarray
        Float32, shape (n, length).
    """
    time = np.arange(length) - n_pre + config.samples_before  # as samples of the window
    inside = (time >= 0) & (time < config.length)
    result = np.zeros((len(windows), length), np.float32)
    result[:, inside] = windows[:, time[inside]]
    late = time >= config.length
    if late.any():
        # 0 for a tail that is not positive; a window need not be aligned
        slope = np.nan_to_num(tail_slope(windows, dt_ns, config.decay_fit_samples))
        # the mean of the last samples is the level at their centre
        since = time[late] - (config.length - 0.5 * (config.tail_samples + 1))
        end = windows[:, -config.tail_samples :].mean(axis=1)
        decay = np.exp(slope[:, np.newaxis] * dt_ns * 1e-6 * since)
        result[:, late] = end[:, np.newaxis] * decay
    result[np.isnan(windows).any(axis=1)] = np.nan
    return result


def with_room(
    windows: FloatArray, config: PreparationConfig, dt_ns: float, reach: int = 0
) -> FloatArray:
    """Extend prepared windows to records (see `record_length`) that are longer by `reach`."""
    before = padding(dt_ns)[0] + config.samples_before
    length = record_length(config.length, dt_ns) + reach
    return extended(windows, config, dt_ns, length, before)


RecordNoise = BaselineNoise | TraceNoise
ByHeight = Callable[[npt.NDArray[Any], npt.NDArray[np.float64]], npt.NDArray[Any]]


class Finished(NamedTuple):
    """Windows, float32, shape ``(n, config.length)``; a row that cannot be prepared is NaN.

    Parameters
    ----------
    windows
        With noise, if any is added.
    codes
        A `cpunet.pulses.preparation.Rejection` for each record.
    clean
        Without noise.
    begin
        Sample of the record with which each window begins; of no meaning if it is NaN.
    """

    windows: FloatArray
    codes: Codes
    clean: FloatArray
    begin: npt.NDArray[np.int64]


def finish(
    records: FloatArray,
    config: PreparationConfig,
    *,
    dt_ns: float,
    noise: RecordNoise | None = None,
    energy_kev: npt.NDArray[np.float64] | None = None,
    seed: int | np.random.Generator = 0,
    added: npt.NDArray[np.float64] | None = None,
    by_height: ByHeight | None = None,
) -> Finished:
    """Align and normalise noise-free records as measured traces are, optionally with noise.

    Noise is added to the whole record once its tail is at the level of the data's. The
    record is then prepared again, so that noise affects alignment, baseline and scale as it
    does in the data.

    Parameters
    ----------
    records
        Noise-free pulses of any height with padding around the window, shape
        ``(n, samples)``.
    config
        Preparation settings of the data.
    dt_ns
        Sampling period in ns.
    noise
        Noise to add, with or without the pile-up tails. None for noise-free
        windows.
    energy_kev
        Energy of each pulse in keV, shape ``(n,)``. Required for noise.
    seed
        Seed or random generator of the noise.
    added
        Added together with the noise, in prepared units, shape ``(n, samples)``.
    by_height
        What the electronics do to records in units of the charge with their noise, given the
        energies.

    Raises
    ------
    CpunetError
        If the noise has another sampling period, or an energy is not above 0.
    """
    if noise is not None and not np.isclose(noise.dt_ns, dt_ns):
        raise CpunetError(
            f"the noise is sampled every {noise.dt_ns:g} ns, the pulses every {dt_ns:g} ns; "
            "take it from the data of the fit"
        )
    # A noise-free record may have equal samples at its top; none of them is clipped.
    config = config.at(dt_ns).model_copy(update={"saturation_run": records.shape[1] + 1})
    rng, n = np.random.default_rng(seed), len(records)
    windows = np.full((n, config.length), np.nan, np.float32)
    noisy = windows if noise is None else windows.copy()
    codes, begin = np.zeros(n, np.uint8), np.zeros(n, np.int64)
    for rows in blocks(n):
        block = records[rows]
        if by_height is not None:
            assert energy_kev is not None  # what a height is
            block = by_height(block, energy_kev[rows])
        clean = prepare(Pulses.of(block, dt_ns=dt_ns), config, "measured")
        codes[rows] = clean.codes
        places = np.arange(n)[rows][clean.index]
        windows[places] = clean.pulses.waveforms
        begin[places] = clean.align_sample - config.samples_before
        if noise is not None:
            assert energy_kev is not None  # noise scales as 1/energy
            height = clean.scale[:, np.newaxis]
            level = (block[clean.index] - clean.baseline[:, np.newaxis]) / height
            drawn = noise.draw(energy_kev[places], block.shape[1], rng)
            if added is not None:
                drawn += added[places]
            noisy_records = np.asarray(level + drawn, np.float32)
            if by_height is not None:
                charge = records[rows][clean.index] + drawn * height
                noisy_records = np.asarray(by_height(charge, energy_kev[places]), np.float32)
            raw = Pulses.of(noisy_records, dt_ns=dt_ns)
            prepared = prepare(raw, config, "measured")
            codes[places] = prepared.codes
            noisy[places[prepared.index]] = prepared.pulses.waveforms
            begin[places[prepared.index]] = prepared.align_sample - config.samples_before
    return Finished(noisy, codes, windows, begin)


log = logging.getLogger(__name__)

NOISE_TRACES = 4096  # number of traces whose baselines determine the noise
MIN_EMPTY = 200  # minimum number of these if traces with tails are left out


def trace_noise(data: InputSet, config: PreparationConfig) -> tuple[TraceNoise, TailsInfo]:
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
    drawn: DrawnTails | None = None
    info = TailsInfo(missing=reason)
    if pile_up is None:
        log.info(f"pile-up tails are not measured: {reason}")
    else:
        likely = drawn_like(pile_up, data, config)
        info = pile_up.describe().model_copy(update={"drawn": likely.describe()})
    if pile_up is not None and pile_up.law is not None:
        drawn, tenth = likely, info.percent_above["10_kev"]["measured"]
        alone = "" if pile_up.coupled else " (by slopes alone: levels do not follow the tilts)"
        log.info(
            f"pile-up tails: {pile_up.law.rate_khz:.2f} ± {pile_up.fit.rate_error_khz:.2f} "
            f"kHz{alone}, {tenth:.2g} % of the traces above 10 keV; translations are "
            "given them"
        )
    return TraceNoise(noise_of(data, pile_up), drawn), info


def tails_of(data: InputSet) -> tuple[PileUpTails | None, str | None]:
    """Pile-up tails of the data and None, or None and why they cannot be estimated."""
    try:
        return PileUpTails.of(_baselines(data)), None
    except CpunetError as error:
        return None, str(error)


def drawn_like(tails: PileUpTails, data: InputSet, config: PreparationConfig) -> DrawnTails:
    """Distribution of tails like that of the data after their quality cuts.

    Parameters
    ----------
    tails
        Pile-up tails measured in the data.
    data
        Measured pulses that passed the cuts.
    config
        Preparation of the pulses.
    """
    windows, whole = data.prepared.pulses.waveforms, _baselines(data).whole
    before = config.at(data.dt_ns).samples_before + padding(data.dt_ns)[0]
    begins = float(np.median(data.prepared.align_sample)) - before
    passed = None
    if data.cuts is not None and whole is not None and tails.law is not None:
        passed = passing(tails, whole, config, data.cuts)
    return DrawnTails(
        law=tails.fit.law,
        height=float(np.median(windows.max(axis=1))),
        lead_us=begins * data.dt_ns * 1e-3,
        dt_ns=data.dt_ns,
        passed=passed,
        decay_error_us=tails.decay_error_us,
    )


def noise_of(data: InputSet, tails: PileUpTails | None = None) -> BaselineNoise:
    """Measure the noise from the raw samples before the pulses.

    If traces have pile-up tails, only those at the level of empty baselines are
    used.

    Raises
    ------
    CpunetError
        If the baselines are too few or too short.
    """
    baselines = _baselines(data)
    first = baselines.first
    usable = np.isfinite(first.energy_kev) & (first.energy_kev > 0)
    usable[NOISE_TRACES:] = False
    if tails is not None and tails.law is not None:
        empty = usable & tails.empty(first)
        usable = empty if empty.sum() >= MIN_EMPTY else usable
    return BaselineNoise.of(baselines, usable)


def _baselines(data: InputSet) -> Baselines:
    assert data.baselines is not None  # these are measured pulses
    return data.baselines
