"""Records of pulses: windows with room around them, and back to windows prepared like the data.

A window is extended with baseline before it and its own decay after it, so that it can be cut
anew once noise is added.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.pulses.container import FloatArray, Pulses, blocks
from cpunet.pulses.parameters import tail_slope
from cpunet.pulses.preparation import Codes, Prepared, prepare
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


# records in units of the charge, energies, and noise as in baselines
ByHeight = Callable[[npt.NDArray[Any], npt.NDArray[np.float64], Any], npt.NDArray[Any]]


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
    noise: BaselineNoise | None = None,
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
        Noise to add, of the same sampling period, with or without pile-up tails. None for
        noise-free windows.
    energy_kev
        Energy of each pulse in keV, shape ``(n,)``. Required for noise.
    seed
        Seed or random generator of the noise.
    added
        Added together with the noise, in prepared units, shape ``(n, samples)``.
    by_height
        What the electronics do to records in units of the charge, given the energies and the
        noise of the records.

    Raises
    ------
    CpunetError
        If an energy is not above 0.
    """
    # A noise-free record may have equal samples at its top; none of them is clipped.
    config = config.at(dt_ns).model_copy(update={"saturation_run": records.shape[1] + 1})
    rng, n = np.random.default_rng(seed), len(records)
    kev = np.full(n, np.nan) if energy_kev is None else energy_kev
    windows = np.full((n, config.length), np.nan, np.float32)
    noisy = windows if noise is None else windows.copy()
    codes, begin = np.zeros(n, np.uint8), np.zeros(n, np.int64)

    def prepared(raw: FloatArray, places: npt.NDArray[np.intp], into: FloatArray) -> Prepared:
        """Prepare records, whose windows belong to some places."""
        done = prepare(Pulses.of(raw, dt_ns=dt_ns), config, "measured")
        codes[places] = done.codes
        into[places[done.index]] = done.pulses.waveforms
        begin[places[done.index]] = done.align_sample - config.samples_before
        return done

    for rows in blocks(n):
        block = records[rows]
        if by_height is not None:
            block = by_height(block, kev[rows], 0.0)
        clean = prepared(block, np.arange(n)[rows], windows)
        if noise is not None:
            places = np.arange(n)[rows][clean.index]
            height = clean.scale[:, np.newaxis]
            level = (block[clean.index] - clean.baseline[:, np.newaxis]) / height
            drawn = noise.draw(kev[places], block.shape[1], rng)
            if added is not None:
                drawn += added[places]
            raw = level + drawn
            if by_height is not None:
                raw = by_height(records[places], kev[places], drawn * height)
            prepared(np.asarray(raw, np.float32), places, noisy)
    return Finished(noisy, codes, windows, begin)
