"""Noise of a readout chain, drawn from a spectrum or cut from measured baselines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import fft

from cpunet.electronics.chain import Electronics, NoiseSpectrum
from cpunet.electronics.exponentials import FloatArray
from cpunet.errors import CpunetError
from cpunet.pulses.reading.opening import open_pulses

# Traces are cut from longer ones (131 us at 16 ns, down to 8 kHz), so that noise slower than
# the record moves its level and the trace's end is independent of its beginning.
_MIN_SAMPLES = 8192
_TRACES_AT_A_TIME = 128
# Measured traces kept for cutting; some tens of MB.
_MAX_BASELINES = 2000


def noise_power(spectrum: NoiseSpectrum, dt_ns: float, n_samples: int) -> FloatArray:
    r"""Fraction of the noise power in each frequency bin of a real FFT.

    .. math:: P(\nu) = c\,\frac{1 + e / (1 + (\nu/\nu_e)^2)}{1 + (\nu/\nu_c)^m}
        + \sum_l a_l\,\delta_{\nu \nu_l}, \qquad \sum_\nu P(\nu) = 1,

    with the symbols of `cpunet.electronics.chain.NoiseSpectrum` and the power fractions
    :math:`a_l` of its lines.

    Parameters
    ----------
    spectrum
        Shape of the spectrum.
    dt_ns, n_samples
        Sampling period in ns and number of samples of the traces.

    Returns
    -------
    array
        Shape ``(n_samples // 2 + 1,)``. Bin 0 is empty: it is the baseline.

    Examples
    --------
    At the corner of a steep roll-off the power is half that of the plateau.

    >>> flat = NoiseSpectrum(corner_MHz=10, order=8, excess=0, excess_corner_kHz=1)
    >>> power = noise_power(flat, dt_ns=10.0, n_samples=1000)
    >>> round(float(power.sum()), 6), round(float(power[100] / power[1]), 3)
    (1.0, 0.5)
    """
    frequency_MHz = fft.rfftfreq(n_samples, dt_ns * 1e-3)
    slow = frequency_MHz / (spectrum.excess_corner_kHz * 1e-3)
    power = (1 + spectrum.excess / (1 + slow**2)) / (
        1 + (frequency_MHz / spectrum.corner_MHz) ** spectrum.order
    )
    power[0] = 0
    if n_samples % 2 == 0:
        power[-1] /= 2  # the Nyquist bin covers half a frequency step
    power *= (1 - sum(line.power_fraction for line in spectrum.lines)) / power.sum()
    for line in spectrum.lines:
        power[max(1, np.abs(frequency_MHz - line.frequency_MHz).argmin())] += (
            line.power_fraction
        )
    return np.asarray(power, np.float64)


def coloured_noise(
    spectrum: NoiseSpectrum, n: int, length: int, dt_ns: float, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    r"""Gaussian noise with a given spectrum and an RMS of 1, shape ``(n, length)``.

    Each real FFT bin is a complex Gaussian whose variance follows `noise_power`. Traces are
    cut from longer ones. The RMS is taken about 0 and includes frequencies down to that of
    these longer traces (8 kHz at 16 ns), so the scatter within a short trace is slightly lower.

    Examples
    --------
    >>> flat = NoiseSpectrum(corner_MHz=10, order=4, excess=0, excess_corner_kHz=1)
    >>> noise = coloured_noise(flat, 20, 1000, 16.0, np.random.default_rng(1))
    >>> bool(abs(noise.std() - 1) < 0.05)
    True
    """
    n_long = max(_MIN_SAMPLES, fft.next_fast_len(2 * length, real=True))
    power = noise_power(spectrum, dt_ns, n_long)
    # irfft divides by n_long, and each bin but the last represents both signs of frequency
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
    """Measured traces without pulses, shape ``(traces, samples)``, with their means removed.

    Parameters
    ----------
    path
        Waveform file in any format that `open_pulses` reads.
    length, dt_ns
        Number of samples and sampling period in ns of the traces to be cut from them.

    Raises
    ------
    CpunetError
        If baselines are too short, sampled differently, not finite, or constant.
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
        if sum(map(len, kept)) >= _MAX_BASELINES:
            break
    baselines = np.concatenate(kept) if kept else np.zeros((0, length), np.float32)
    finite = np.isfinite(baselines).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise CpunetError(f"{path}: baseline {bad} is not finite; leave it out")
    if not baselines.std() > 0:
        raise CpunetError(f"{path}: no baselines that vary; give another noise.baselines_file")
    return baselines


def cut_noise(
    baselines: npt.NDArray[np.float32], n: int, length: int, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Random windows of measured baselines, scaled to a common RMS of 1.

    Parameters
    ----------
    baselines
        Output of `read_baselines`.
    n, length
        Number of windows and of samples in each.
    rng
        Random generator.
    """
    trace = rng.integers(len(baselines), size=n)
    begin = rng.integers(baselines.shape[1] - length + 1, size=n)
    windows = baselines[trace[:, None], begin[:, None] + np.arange(length)]
    return np.asarray(windows / baselines.std(dtype=np.float64), np.float32)


def noise_of(
    electronics: Electronics, n: int, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Noise in keV of `n` traces of a chain, shape ``(n, electronics.length)``.

    Parameters
    ----------
    electronics
        The readout chain.
    n
        Number of traces.
    rng
        Random generator.

    Raises
    ------
    CpunetError
        If the file of baselines cannot be used.
    """
    noise, length, dt_ns = electronics.noise, electronics.length, electronics.dt_ns
    if noise.spectrum is not None:
        unit = coloured_noise(noise.spectrum, n, length, dt_ns, rng)
    else:
        assert noise.baselines_file is not None  # Noise validates this
        unit = cut_noise(read_baselines(noise.baselines_file, length, dt_ns), n, length, rng)
    return unit * np.float32(noise.rms_kev)
