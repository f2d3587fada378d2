"""What else is in a trace: what earlier pulses have left, second pulses, and a slow wave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cpunet.electronics.chain import Electronics
from cpunet.electronics.exponentials import FloatArray
from cpunet.electronics.remains_law import LIFETIMES, earlier_pulses
from cpunet.electronics.response import linear_response
from cpunet.pulses.container import Pulses


@dataclass(frozen=True, eq=False)
class OtherPulses:
    """What is added to the traces, and what is known of it.

    Parameters
    ----------
    added_kev
        Signal in keV, shape ``(n, length)``.
    remains_kev
        What earlier pulses have left at the beginning of each trace, in keV.
    n_piled
        Pulses within each trace besides its own.
    piled_kev, piled_ns
        Energy of the largest of them, and how long after the trace's own it began
        (negative: before); NaN where there is none.
    """

    added_kev: FloatArray
    remains_kev: FloatArray
    n_piled: npt.NDArray[np.int64]
    piled_kev: FloatArray
    piled_ns: FloatArray


def draw_other_pulses(
    pulses: Pulses, electronics: Electronics, rng: np.random.Generator
) -> OtherPulses:
    """Draw the other pulses of traces by Poisson processes, see `cpunet.electronics.chain`.

    Parameters
    ----------
    pulses
        Of the traces; second pulses have the shapes of these.
    electronics
        The chain, with the rates.
    rng
        Of everything drawn.
    """
    remains, second, slow = rng.spawn(3)
    added_kev = _remains(len(pulses), electronics, remains)
    # before the slow wave and the second pulses come on top
    remains_kev = added_kev[:, 0].copy()
    n_piled, piled_kev, piled_ns = _add_second(pulses, electronics, added_kev, second)
    if electronics.hum is not None:
        added_kev += _hum(len(pulses), electronics, slow)
    return OtherPulses(added_kev, remains_kev, n_piled, piled_kev, piled_ns)


def _remains(n: int, electronics: Electronics, rng: np.random.Generator) -> FloatArray:
    """Tails of earlier pulses in keV, with all decays of the chain, shape ``(n, length)``."""
    transfer = electronics.transfer
    longest_us = LIFETIMES * max(part.tau_us for part in electronics.decays)
    row, kev, before_us = earlier_pulses(
        n, electronics.earlier_pulses.rate_kHz, longest_us, electronics.other_pulses_kev, rng
    )
    # a step response is a sum of exponentials, and so is what is left of many steps
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
    """Add second pulses, anywhere in the record and of the shape of any other of the set."""
    n, dt_ns = len(pulses), electronics.dt_ns
    length_us = 1e-3 * electronics.length * dt_ns
    row, kev, time_us = earlier_pulses(
        n, electronics.pile_up.rate_kHz, length_us, electronics.other_pulses_kev, rng
    )
    after_ns = 1e3 * time_us - electronics.n_pre * dt_ns
    which = rng.integers(max(n, 1), size=len(row))
    shapes = linear_response(pulses[which], electronics, after_ns)
    np.add.at(added_kev, row, kev[:, np.newaxis] * shapes)
    piled_kev, piled_ns = np.full(n, np.nan), np.full(n, np.nan)
    order = np.argsort(kev, kind="stable")  # the largest is written last
    piled_kev[row[order]], piled_ns[row[order]] = kev[order], after_ns[order]
    return np.bincount(row, minlength=n), piled_kev, piled_ns


def _hum(n: int, electronics: Electronics, rng: np.random.Generator) -> FloatArray:
    """A wave of the mains at any phase, in keV, shape ``(n, length)``."""
    assert electronics.hum is not None  # asked before
    phase = rng.uniform(0, 2 * np.pi, size=(n, 1))
    turns = np.arange(electronics.length) * electronics.dt_ns * 1e-9
    wave = np.sin(2 * np.pi * electronics.hum.frequency_Hz * turns + phase)
    return np.asarray(electronics.hum.amplitude_kev * wave, float)
