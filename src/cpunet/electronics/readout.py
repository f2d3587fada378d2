"""From ideal pulses to raw traces as a digitiser writes them, with the truth stored.

Noise has a spectrum; earlier pulses, and others within the record, disturb the traces.

Exact response of the chain to charge pulses: digitiser samples without noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from numba import prange
from scipy import fft

from cpunet.electronics.baseline_noise import require_energies
from cpunet.electronics.chain import REFERENCE_KEV, Electronics, FloatArray, NoiseSpectrum
from cpunet.electronics.drawn_pile_up import LIFETIMES, InTracePileUp, earlier_pulses
from cpunet.errors import CpunetError
from cpunet.kernels import kernel
from cpunet.pulses.container import FloatArray as PulseArray
from cpunet.pulses.container import Pulses


def linear_response(
    pulses: Pulses, electronics: Electronics, shift_ns: FloatArray | float = 0.0
) -> FloatArray:
    r"""Noise-free traces of charge pulses, in units of the full charge.

    Each sample of a pulse :math:`q` is the constant charge during its period. The chain's
    exponentials follow it without approximation. A digitiser sample is the mean over the
    digitiser's own period :math:`\Delta t`,

    .. math:: s_k = \frac{1}{\Delta t} \int_{k \Delta t}^{(k+1) \Delta t} (h * q)(t)\,dt,

    with the impulse response :math:`h` of the chain. The charge is zero before a pulse and
    constant after its last sample.

    Parameters
    ----------
    pulses
        Ideal pulses from 0 to 1. Their sampling period must divide that of the digitiser.
    electronics
        The readout chain.
    shift_ns
        Start of each pulse after `n_pre` samples, in ns; shape ``(n,)`` or a number.

    Returns
    -------
    array
        Shape ``(n, electronics.length)``.

    Raises
    ------
    CpunetError
        If the pulses are sampled too coarsely for the chain.

    Examples
    --------
    A step through one pole without decay approaches the full charge.

    >>> from cpunet.electronics.chain import read_electronics
    >>> step = Pulses.of(np.ones((1, 10)), dt_ns=4)
    >>> chain = read_electronics("legend200")
    >>> trace = linear_response(step, chain)[0]
    >>> trace.shape, bool(trace[: chain.n_pre].any())
    ((1400,), False)
    """
    where, poles = f"electronics {electronics.name}", electronics.bandwidth_poles_ns
    ratio = electronics.dt_ns / pulses.dt_ns
    if ratio < 1 - 1e-9 or abs(ratio - round(ratio)) > 1e-9:
        raise CpunetError(
            f"{where}: dt_ns = {electronics.dt_ns:g} is no multiple of the pulses' "
            f"{pulses.dt_ns:g} ns; simulate them with a period that divides it"
        )
    if min(poles) < pulses.dt_ns:
        raise CpunetError(
            f"{where}: bandwidth_poles_ns means {min(poles):.3g} ns, faster than the pulses' "
            f"grid of {pulses.dt_ns:g} ns; correct it, or simulate them with a shorter period"
        )
    dt, fine = electronics.dt_ns, pulses.dt_ns
    start = electronics.n_pre * dt + np.zeros(len(pulses)) + shift_ns
    first = np.floor(start / dt).astype(np.int64)
    phase = start - first * dt
    # position of the first clock tick within a fine sample, and the index of that sample
    tick = np.mod(-phase, fine)
    first_tick = np.rint((dt - phase - tick) / fine).astype(np.int64)
    # For y' = p y + x at constant x, y changes over a step by e y + a x with e = exp(p h) - 1,
    # and its integral is a y + b x. Steps end at a tick, begin there, or last a whole sample.
    transfer, traces = electronics.transfer, np.zeros((len(pulses), electronics.length))
    steps_ns = np.stack([tick, fine - tick, np.full_like(tick, dt)], axis=1)[..., np.newaxis]
    gain = np.expm1(transfer.poles * steps_ns)
    a = gain / transfer.poles
    factors = np.stack([1 + gain, a, (a - steps_ns) / transfer.poles], axis=-1)
    charge, weights = np.ascontiguousarray(pulses.waveforms), transfer.residues / dt
    _follow(charge, factors, weights, first, first_tick, round(ratio), traces)
    return traces


@kernel(parallel=True)
def _follow(
    pulses: Any, factors: Any, weights: Any, first: Any, tick: Any, per_sample: int, traces: Any
) -> None:  # pragma: no cover - compiled
    """Fill each trace: fine steps while charge moves, each in two parts, then whole samples.

    `tick` is the fine sample with the first tick of the digitiser's clock.
    """
    n_fine, length = pulses.shape[1], traces.shape[1]
    for i in prange(len(pulses)):
        state = np.zeros(len(weights), np.complex128)
        total = np.zeros(len(weights), np.complex128)
        row, j, part = first[i], 0, 0
        while row < length:
            x = float(pulses[i, min(j, n_fine - 1)])
            step = factors[i, part]
            for k in range(len(state)):
                total[k] += step[k, 1] * state[k] + step[k, 2] * x
                state[k] = step[k, 0] * state[k] + step[k, 1] * x
            since = j - tick[i]
            if part == 2 or (part == 0 and since >= 0 and since % per_sample == 0):
                value = 0.0
                for k in range(len(state)):
                    value += (weights[k] * total[k]).real
                    total[k] = 0.0
                if row >= 0:
                    traces[i, row] = value
                row += 1
                part = 2 if j >= n_fine else 1
            elif part == 0:
                part = 1
            else:
                part, j = 0, j + 1


# Traces are cut from longer ones (8192 samples of 16 ns, down to 8 kHz), so that noise slower
# than the record moves its level and the trace's end is independent of its beginning.
_MIN_NS = 131_072
_TRACES_AT_A_TIME = 128


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
    fast = (frequency_MHz / spectrum.corner_MHz) ** spectrum.order
    power = (1 + spectrum.excess / (1 + slow**2)) / (1 + fast)
    power[0] = 0
    if n_samples % 2 == 0:
        power[-1] /= 2  # the Nyquist bin covers half a frequency step
    power *= (1 - sum(line.power_fraction for line in spectrum.lines)) / power.sum()
    for line in spectrum.lines:
        nearest = np.abs(frequency_MHz - line.frequency_MHz).argmin()
        power[max(1, nearest)] += line.power_fraction
    return np.asarray(power, np.float64)


def coloured_noise(
    spectrum: NoiseSpectrum, n: int, length: int, dt_ns: float, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    r"""Gaussian noise with a given spectrum and an RMS of 1, shape ``(n, length)``.

    Each real FFT bin is a complex Gaussian whose variance follows `noise_power`. Traces are
    cut from longer ones. The RMS is taken about 0 and includes frequencies down to that of
    these longer traces (8 kHz), so the scatter within a short trace is slightly lower.

    Examples
    --------
    >>> flat = NoiseSpectrum(corner_MHz=10, order=4, excess=0, excess_corner_kHz=1)
    >>> noise = coloured_noise(flat, 20, 1000, 16.0, np.random.default_rng(1))
    >>> bool(abs(noise.std() - 1) < 0.05)
    True
    """
    n_long = fft.next_fast_len(max(round(_MIN_NS / dt_ns), 2 * length), real=True)
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


FLAGS = {"decaying baseline": 1, "pile-up": 2, "saturated": 4}
"""Bits of a trace's flags. A baseline decays if its tail exceeds the noise RMS."""


@dataclass(frozen=True, eq=False, repr=False)
class RawTraces(Pulses):
    """Raw traces, in ADC counts of uint16, and the truth behind them.

    Parameters
    ----------
    response
        Noise-free pulses at their own clock phase in units of the full charge, without
        baseline and without earlier or piled-up pulses. Float32, shape ``(n, length)``.
    true_energy_kev, baseline_adc
        Scale in keV and offset in ADC counts of each pulse.
    disturbed
        How each trace is disturbed, arrays of shape ``(n,)``. ``flag``: uint8 sum of 1
        (decaying baseline), 2 (pile-up) and 4 (saturated); ``tails_kev``: sum of the pile-up
        tails at the first sample; ``n_piled``: number of additional pulses within the trace;
        ``piled_kev``, ``piled_ns``: energy of the largest of these, and its start after that
        of the trace's own pulse (negative: before it), NaN where there is none.
    """

    response: npt.NDArray[np.float32]
    true_energy_kev: FloatArray
    baseline_adc: FloatArray
    disturbed: dict[str, npt.NDArray[Any]]


def by_height(
    signal: FloatArray, electronics: Electronics, kev: FloatArray | float = 1.0
) -> FloatArray:
    """Signals as an amplifier of limited slew rate and a digitiser leave them.

    Parameters
    ----------
    signal
        Shape ``(pulses, samples)``.
    kev
        Height in keV of a signal of 1, a number or of shape ``(pulses, 1)``.
    """
    slew, off = electronics.slew_kev_per_ns, electronics.nonlinearity
    if slew is None and off is None:
        return signal
    result = kev * signal
    if slew is not None:
        limit = slew * electronics.dt_ns
        for i in range(1, result.shape[1]):
            ahead = result[:, i] - result[:, i - 1]
            result[:, i] = result[:, i - 1] + limit * np.tanh(ahead / limit)
    if off is not None:
        full = electronics.adc_top / electronics.gain_adc_per_kev
        result += off.fraction * full * np.sin(2 * np.pi * off.waves * result / full)
    return result / kev


def read_out(pulses: Pulses, electronics: Electronics, seed: int) -> RawTraces:
    """Pass ideal pulses through a readout chain; energies have the resolution of the chain.

    Parameters
    ----------
    pulses
        Charge pulses from 0 to 1 with true energies, sampled more finely than the digitiser
        (1 to 4 ns). All are held in memory: split large sets into blocks.
    electronics
        The readout chain.
    seed
        Seed of the random generator. The same seed gives the same traces.

    Raises
    ------
    CpunetError
        If an energy is not above 0, or as `cpunet.electronics.readout.linear_response`.

    Examples
    --------
    >>> from cpunet.electronics.chain import read_electronics
    >>> step = Pulses.of(np.ones((2, 900)), dt_ns=4, energy_kev=[1592.5, 2614.5])
    >>> traces = read_out(step, read_electronics("legend200"), seed=1)
    >>> traces.waveforms.shape, traces.waveforms.dtype
    ((2, 1400), dtype('uint16'))
    """
    energy, n, transfer = pulses.energy_kev, len(pulses), electronics.transfer
    dt_ns, length, n_pre = electronics.dt_ns, electronics.length, electronics.n_pre
    require_energies(energy, pulses.event_number)
    clock, others, noise, level, resolution = np.random.default_rng(seed).spawn(5)
    # a uniform clock phase plus trigger jitter
    shift_ns = clock.uniform(0, dt_ns, size=n)
    shift_ns += clock.normal(0, electronics.trigger_jitter_ns, size=n)
    response = linear_response(pulses, electronics, shift_ns)

    # pile-up tails with all decays of the chain: a step response is a sum of exponentials, and
    # so is the sum of many tails
    tails, within = others.spawn(2)
    longest_us = LIFETIMES * max(part.tau_us for part in electronics.decays)
    rate_khz, energies_kev = electronics.earlier_pulses.rate_kHz, electronics.other_pulses_kev
    row, kev, before_us = earlier_pulses(n, rate_khz, longest_us, energies_kev, tails)
    modes = kev[:, np.newaxis] * np.exp(1e3 * before_us[:, np.newaxis] * transfer.poles)
    heights = np.zeros((n, len(transfer.poles)), np.complex128)
    np.add.at(heights, row, modes * (transfer.residues / transfer.poles))
    centres_ns = (np.arange(length) + 0.5) * dt_ns
    decays = np.exp(transfer.poles[:, np.newaxis] * centres_ns)
    added_kev = np.ascontiguousarray((heights @ decays).real)
    tails_kev = added_kev[:, 0].copy()  # before piled-up pulses are added

    # in-trace pile-up, with shapes of randomly chosen pulses
    rate_khz = electronics.pile_up.rate_kHz
    piled = InTracePileUp.draw(n, rate_khz, energies_kev, dt_ns, n_pre, length, within)
    shapes = linear_response(pulses[piled.partner], electronics, piled.after_ns)
    np.add.at(added_kev, piled.row, piled.kev[:, np.newaxis] * shapes)
    disturbed = {name: values for name, (values, _) in piled.columns().items()}
    disturbed["piled_ns"] -= shift_ns

    own = electronics.noise
    unit = coloured_noise(own.spectrum, n, length, dt_ns, noise)
    total_kev = energy[:, None] * response + added_kev + unit * np.float32(own.rms_kev)
    total_kev = by_height(total_kev, electronics)
    mean, spread = electronics.baseline_mean_adc, electronics.baseline_spread_adc
    baseline = level.normal(mean, spread, size=n)
    adc = np.rint(baseline[:, None] + electronics.gain_adc_per_kev * total_kev)
    beyond = (adc > electronics.adc_top) | (adc < 0)
    flags = tails_kev > own.rms_kev, disturbed["n_piled"] > 0, beyond.any(axis=1)
    flag = np.asarray([*FLAGS.values()] @ np.array(flags), np.uint8)
    # the resolution grows with the root of the energy
    fwhm_kev = np.sqrt(electronics.resolution_fwhm_kev**2 / REFERENCE_KEV * energy)
    smeared = np.random.default_rng(int(resolution.integers(2**63)))
    return RawTraces(
        waveforms=cast(PulseArray, np.clip(adc, 0, electronics.adc_top).astype(np.uint16)),
        dt_ns=dt_ns,
        energy_kev=smeared.normal(energy, fwhm_kev / math.sqrt(8 * math.log(2))),
        event_number=pulses.event_number,
        peak=pulses.peak,
        t0_ns=np.zeros(n),
        response=by_height(response, electronics, energy[:, None]).astype(np.float32),
        true_energy_kev=energy,
        baseline_adc=baseline,
        disturbed={"flag": flag, "tails_kev": tails_kev, **disturbed},
    )
