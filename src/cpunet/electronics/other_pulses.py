"""Disturbances of a trace: other pulses, mains hum and wandering baselines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from cpunet.electronics.chain import Electronics, Wander
from cpunet.electronics.exact_response import linear_response
from cpunet.electronics.exponentials import FloatArray
from cpunet.electronics.remains_law import LIFETIMES, earlier_pulses
from cpunet.electronics.second_pulses import SecondPulses
from cpunet.pulses.container import Pulses


@dataclass(frozen=True, eq=False)
class OtherPulses:
    """The disturbances added to the traces and their truth.

    Parameters
    ----------
    added_kev
        Added signal in keV, shape ``(n, length)``.
    remains_kev
        Sum of the tails of earlier pulses at the first sample of each trace, in keV.
    n_piled
        Number of additional pulses within each trace.
    piled_kev, piled_ns
        Energy of the largest additional pulse, and its start after `n_pre` samples in ns
        (negative: before them). NaN where there is none.
    """

    added_kev: FloatArray
    remains_kev: FloatArray
    n_piled: npt.NDArray[np.int64]
    piled_kev: FloatArray
    piled_ns: FloatArray


def draw_other_pulses(
    pulses: Pulses, electronics: Electronics, rng: np.random.Generator
) -> OtherPulses:
    """Draw the other pulses of each trace, see `cpunet.electronics.chain`.

    Parameters
    ----------
    pulses
        Pulses of the traces. Second pulses take their shapes.
    electronics
        The readout chain with the rates.
    rng
        Random generator.
    """
    remains, second, slow = rng.spawn(3)
    added_kev = _remains(len(pulses), electronics, remains)
    # before hum and second pulses are added
    remains_kev = added_kev[:, 0].copy()
    n_piled, piled_kev, piled_ns = _add_second(pulses, electronics, added_kev, second)
    if electronics.hum is not None:
        added_kev += _hum(len(pulses), electronics, slow)
    if electronics.wander is not None:
        wander, dt_ns = electronics.wander, electronics.dt_ns
        # its own generator, so that it does not change the other random numbers
        (drift,) = rng.spawn(1)
        added_kev += _wander(len(pulses), electronics.length, dt_ns, wander, drift)
    return OtherPulses(added_kev, remains_kev, n_piled, piled_kev, piled_ns)


def _remains(n: int, electronics: Electronics, rng: np.random.Generator) -> FloatArray:
    """Tails of earlier pulses in keV, with all decays of the chain, shape ``(n, length)``."""
    transfer = electronics.transfer
    longest_us = LIFETIMES * max(part.tau_us for part in electronics.decays)
    row, kev, before_us = earlier_pulses(
        n, electronics.earlier_pulses.rate_kHz, longest_us, electronics.other_pulses_kev, rng
    )
    # a step response is a sum of exponentials, and so is the sum of many tails
    weights = transfer.residues / transfer.poles
    modes = kev[:, np.newaxis] * np.exp(1e3 * before_us[:, np.newaxis] * transfer.poles)
    heights = np.zeros((n, len(weights)), np.complex128)
    np.add.at(heights, row, modes * weights)
    centres_ns = (np.arange(electronics.length) + 0.5) * electronics.dt_ns
    decays = np.exp(transfer.poles[:, np.newaxis] * centres_ns)
    return np.ascontiguousarray((heights @ decays).real)


def _add_second(
    pulses: Pulses, electronics: Electronics, added_kev: FloatArray, rng: np.random.Generator
) -> tuple[npt.NDArray[np.int64], FloatArray, FloatArray]:
    """Add second pulses anywhere in the record, with shapes of randomly chosen pulses."""
    dt_ns = electronics.dt_ns
    second = SecondPulses.draw(
        len(pulses),
        electronics.pile_up.rate_kHz,
        electronics.other_pulses_kev,
        electronics.n_pre * dt_ns,
        electronics.length * dt_ns,
        rng,
    )
    shapes = linear_response(pulses[second.partner], electronics, second.after_ns)
    np.add.at(added_kev, second.row, second.kev[:, np.newaxis] * shapes)
    return second.largest()


def _hum(n: int, electronics: Electronics, rng: np.random.Generator) -> FloatArray:
    """Mains hum with random phases in keV, shape ``(n, length)``."""
    assert electronics.hum is not None  # checked by the caller
    phase = rng.uniform(0, 2 * np.pi, size=(n, 1))
    turns = np.arange(electronics.length) * electronics.dt_ns * 1e-9
    wave = np.sin(2 * np.pi * electronics.hum.frequency_Hz * turns + phase)
    return np.asarray(electronics.hum.amplitude_kev * wave, float)


def _wander(
    n: int, length: int, dt_ns: float, wander: Wander, rng: np.random.Generator
) -> FloatArray:
    """Slow wandering in keV, shape ``(n, length)``: exact samples of its process."""
    lost = 1e-3 * dt_ns / wander.time_us
    steps = rng.normal(0, wander.rms_kev * np.sqrt(-np.expm1(-2 * lost)), (n, length))
    steps[:, 0] = rng.normal(0, wander.rms_kev, n)  # stationary from the start
    return np.asarray(lfilter([1.0], [1.0, -np.exp(-lost)], steps, axis=1), float)
