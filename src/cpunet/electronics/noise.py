"""Noise of a chain: with a given spectrum, or cut from measured baselines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import fft

from cpunet.electronics.chain import Electronics, NoiseSpectrum
from cpunet.electronics.exponentials import FloatArray
from cpunet.errors import CpunetError
from cpunet.pulses.reading.opening import open_pulses

# Traces are cut from longer ones, so that noise slower than the record is a wander of its
# level, and the trace's end knows nothing of its beginning: 131 us at 16 ns, down to 8 kHz.
_LEAST_SAMPLES = 8192
_TRACES_AT_A_TIME = 128
# Measured traces kept for cutting; some tens of MB.
_MOST_BASELINES = 2000


def noise_power(spectrum: NoiseSpectrum, dt_ns: float, n_samples: int) -> FloatArray:
    """Share of the noise power in each frequency of a real FFT, adding up to 1.

    Parameters
    ----------
    spectrum
        Its shape.
    dt_ns, n_samples
        Sampling period in ns and length of the traces.

    Returns
    -------
    array
        Shape ``(n_samples // 2 + 1,)``; nothing at frequency 0, which is the baseline.
    """
    frequency_MHz = fft.rfftfreq(n_samples, dt_ns * 1e-3)
    slow = frequency_MHz / (spectrum.excess_corner_kHz * 1e-3)
    power = (1 + spectrum.excess / (1 + slow**2)) / (
        1 + (frequency_MHz / spectrum.corner_MHz) ** spectrum.order
    )
    power[0] = 0
    if n_samples % 2 == 0:
        power[-1] /= 2  # half the sampling rate stands for half a step of frequency
    power *= (1 - sum(line.power_fraction for line in spectrum.lines)) / power.sum()
    for line in spectrum.lines:
        power[max(1, np.abs(frequency_MHz - line.frequency_MHz).argmin())] += (
            line.power_fraction
        )
    return np.asarray(power, np.float64)


def coloured_noise(
    spectrum: NoiseSpectrum, n: int, length: int, dt_ns: float, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Gaussian noise of RMS 1 with a given spectrum, shape ``(n, length)``.

    The RMS is about 0 and counts frequencies down to that of the long traces of which these
    are parts (8 kHz at 16 ns), so that the scatter within a short trace is a little less.
    """
    n_long = max(_LEAST_SAMPLES, fft.next_fast_len(2 * length, real=True))
    power = noise_power(spectrum, dt_ns, n_long)
    # irfft divides by n_long, and each frequency but the last is there twice
    scale = n_long * np.sqrt(power / 4)
    scale[-1] = n_long * np.sqrt(power[-1] / (1 if n_long % 2 == 0 else 4))
    noise = np.empty((n, length), np.float32)
    for begin in range(0, n, _TRACES_AT_A_TIME):
        part = noise[begin : begin + _TRACES_AT_A_TIME]
        shape = (len(part), len(power))
        modes = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) * scale
        if n_long % 2 == 0:
            modes[:, -1] = modes[:, -1].real
        part[:] = fft.irfft(modes, n_long, axis=1, overwrite_x=True)[:, :length]
    return noise


def read_baselines(path: Path, length: int, dt_ns: float) -> npt.NDArray[np.float32]:
    """Measured traces without pulses, shape ``(traces, samples)``, each less its mean.

    Parameters
    ----------
    path
        Any file of waveforms that `open_pulses` reads.
    length, dt_ns
        Of the traces to be cut from them.

    Raises
    ------
    CpunetError
        If they are too short, sampled otherwise, or do not vary.
    """
    source = open_pulses(path)
    if not np.isclose(source.dt_ns, dt_ns):
        raise CpunetError(
            f"{path}: baselines sampled every {source.dt_ns:g} ns, the electronics every "
            f"{dt_ns:g} ns; give others as noise.baselines_file"
        )
    kept: list[npt.NDArray[np.float32]] = []
    for block in source.blocks(256):
        if block.length < length:
            raise CpunetError(
                f"{path}: baselines of {block.length} samples are shorter than the record of "
                f"{length}; lower length or give longer noise.baselines_file"
            )
        kept.append(block.waveforms - block.waveforms.mean(axis=1, keepdims=True))
        if sum(map(len, kept)) >= _MOST_BASELINES:
            break
    baselines = np.concatenate(kept) if kept else np.zeros((0, length), np.float32)
    if not (np.isfinite(baselines).all() and baselines.std() > 0):
        raise CpunetError(f"{path}: no baselines that vary; give another noise.baselines_file")
    return baselines


def cut_noise(
    baselines: npt.NDArray[np.float32], n: int, length: int, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Windows from measured baselines, at random, scaled to an RMS of 1 over all of them.

    Parameters
    ----------
    baselines
        As `read_baselines` gives them.
    n, length
        Shape of the result.
    rng
        Of the choice.
    """
    trace = rng.integers(len(baselines), size=n)
    begin = rng.integers(baselines.shape[1] - length + 1, size=n)
    windows = baselines[trace[:, None], begin[:, None] + np.arange(length)]
    return np.asarray(windows / baselines.std(dtype=np.float64), np.float32)


def noise_of(
    electronics: Electronics, n: int, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Noise in keV of `n` traces of a chain, shape ``(n, electronics.length)``.

    Raises
    ------
    CpunetError
        If the file of baselines cannot be used.
    """
    noise, length, dt_ns = electronics.noise, electronics.length, electronics.dt_ns
    if noise.spectrum is not None:
        unit = coloured_noise(noise.spectrum, n, length, dt_ns, rng)
    else:
        assert noise.baselines_file is not None  # as Noise makes sure
        unit = cut_noise(read_baselines(noise.baselines_file, length, dt_ns), n, length, rng)
    return unit * np.float32(noise.rms_kev)
