"""From the response of the electronics to windows prepared exactly as those of the data."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.drawn_remains import SameNoise, TraceNoise
from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.preparation import Codes, prepare
from cpunet.recipes.schema import PreparationConfig

Noise = BaselineNoise | TraceNoise | SameNoise

BLOCK = 512  # pulses at a time, to bound memory


def blocks(n: int) -> Iterator[slice]:
    """Slices of `BLOCK` rows that cover `n` pulses."""
    return (slice(first, first + BLOCK) for first in range(0, n, BLOCK))


def finish(
    records: FloatArray,
    config: PreparationConfig,
    *,
    dt_ns: float,
    noise: Noise | None = None,
    energy_kev: npt.NDArray[np.float64] | None = None,
    seed: int | np.random.Generator = 0,
) -> FloatArray:
    """Align and normalise noise-free records as measured traces are, optionally with noise.

    Noise is added to the whole record once its tail is at the level of the data's. The
    record is then prepared again, so that noise affects alignment, baseline and scale as it
    does in the data. A pulse without decay cannot be aligned once noise is added: finish
    `Raw` without noise.

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
        Noise to add, with or without the tails of earlier pulses. None for noise-free
        windows.
    energy_kev
        Energy of each pulse in keV, shape ``(n,)``. Required for noise.
    seed
        Seed or random generator of the noise.

    Returns
    -------
    numpy.ndarray
        Windows, float32, shape ``(n, config.length)``. A row is NaN if the pulse cannot be
        prepared.

    Raises
    ------
    CpunetError
        If shapes, sampling periods or energies do not match.
    """
    windows, _ = finish_with_codes(
        records, config, dt_ns=dt_ns, noise=noise, energy_kev=energy_kev, seed=seed
    )
    return windows


def finish_with_codes(
    records: FloatArray,
    config: PreparationConfig,
    *,
    dt_ns: float,
    noise: Noise | None = None,
    energy_kev: npt.NDArray[np.float64] | None = None,
    seed: int | np.random.Generator = 0,
    added: npt.NDArray[np.float64] | None = None,
) -> tuple[FloatArray, Codes]:
    """As `finish`, with a `cpunet.pulses.preparation.Rejection` code for each record.

    `added` is added together with the noise, in prepared units, shape ``(n, samples)``.
    """
    clean, noisy, codes = _finished(records, config, dt_ns, noise, energy_kev, seed, added)
    return clean if noise is None else noisy, codes


def finish_both(
    records: FloatArray,
    config: PreparationConfig,
    *,
    dt_ns: float,
    noise: Noise,
    energy_kev: npt.NDArray[np.float64],
    seed: int | np.random.Generator = 0,
) -> tuple[FloatArray, FloatArray]:
    """`finish` without and with noise, at the cost of the latter alone."""
    clean, noisy, _ = _finished(records, config, dt_ns, noise, energy_kev, seed)
    return clean, noisy


def _finished(
    records: FloatArray,
    config: PreparationConfig,
    dt_ns: float,
    noise: Noise | None,
    energy_kev: npt.NDArray[np.float64] | None,
    seed: int | np.random.Generator,
    added: npt.NDArray[np.float64] | None = None,
) -> tuple[FloatArray, FloatArray, Codes]:
    """Windows without noise, windows with noise (empty without one), and rejection codes."""
    if records.ndim != 2:
        raise CpunetError(
            f"translated waveforms have shape {records.shape}; expected (pulses, samples)"
        )
    if noise is not None:
        _check_noise(noise, dt_ns, energy_kev, len(records))
    # A noise-free record may have equal samples at its top; none of them is clipped.
    config = config.model_copy(update={"saturation_run": records.shape[1] + 1})
    rng, n = np.random.default_rng(seed), len(records)
    windows = np.full((n, config.length), np.nan, np.float32)
    noisy = np.full((0 if noise is None else n, config.length), np.nan, np.float32)
    codes = np.zeros(n, np.uint8)
    for rows in blocks(n):
        block = records[rows]
        clean = prepare(Pulses.of(block, dt_ns=dt_ns), config, "measured")
        codes[rows] = clean.codes
        kept = np.arange(n)[rows][clean.index]
        windows[kept] = clean.pulses.waveforms
        if noise is not None and energy_kev is not None:
            height = clean.scale[:, np.newaxis]
            level = (block[clean.index] - clean.baseline[:, np.newaxis]) / height
            drawn = noise.draw(energy_kev[kept], block.shape[1], rng)
            if added is not None:
                drawn += added[kept]
            raw = Pulses.of(np.asarray(level + drawn, np.float32), dt_ns=dt_ns)
            prepared = prepare(raw, config, "measured")
            codes[kept] = prepared.codes
            noisy[kept[prepared.index]] = prepared.pulses.waveforms
    return windows, noisy, codes


def _check_noise(
    noise: Noise,
    dt_ns: float,
    energy_kev: npt.NDArray[np.float64] | None,
    n: int,
) -> None:
    if not np.isclose(noise.dt_ns, dt_ns):
        raise CpunetError(
            f"the noise is sampled every {noise.dt_ns:g} ns, the pulses every {dt_ns:g} ns; "
            "take it from the data of the fit"
        )
    if energy_kev is None or energy_kev.shape != (n,):
        raise CpunetError(
            f"noise for {n} pulses needs {n} energies, since it is scaled by 1/energy; "
            "give energy_kev"
        )
