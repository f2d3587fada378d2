"""Exact response of the chain to charge pulses: digitiser samples without noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import prange

from cpunet.electronics.chain import Electronics
from cpunet.electronics.exponentials import ComplexArray, FloatArray
from cpunet.errors import CpunetError
from cpunet.kernels import kernel
from cpunet.pulses.container import Pulses


def linear_response(
    pulses: Pulses, electronics: Electronics, shift_ns: npt.ArrayLike | None = None
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
    per_sample = _fine_per_sample(pulses, electronics)
    n, dt, fine = len(pulses), electronics.dt_ns, pulses.dt_ns
    shift = np.broadcast_to(0.0 if shift_ns is None else np.asarray(shift_ns, float), (n,))
    start = electronics.n_pre * dt + shift
    first = np.floor(start / dt).astype(np.int64)
    phase = start - first * dt
    # position of the first clock tick within a fine sample, and the index of that sample
    tick = np.mod(-phase, fine)
    first_tick = np.rint((dt - phase - tick) / fine).astype(np.int64)
    transfer = electronics.transfer
    traces = np.zeros((n, electronics.length))
    _follow(
        np.ascontiguousarray(pulses.waveforms),
        _steps(transfer.poles, tick),
        _steps(transfer.poles, fine - tick),
        _steps(transfer.poles, np.array([dt]))[0],
        transfer.residues / dt,
        first,
        first_tick,
        per_sample,
        traces,
    )
    return traces


def _fine_per_sample(pulses: Pulses, electronics: Electronics) -> int:
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
    return round(ratio)


def _steps(poles: ComplexArray, h_ns: FloatArray) -> ComplexArray:
    """Propagation factors over steps of `h_ns` at constant input.

    The shape is ``(steps, poles, 3)``. For ``y' = p y + x``, y changes by ``e y + a x`` with
    ``e = exp(p h) - 1``, and its integral over the step is ``a y + b x``.
    """
    h = h_ns[:, None]
    gain = np.expm1(poles * h)
    a = gain / poles
    return np.stack([1 + gain, a, (a - h) / poles], axis=-1)


@kernel
def _advance(
    state: Any, total: Any, factors: Any, x: float
) -> None:  # pragma: no cover - compiled
    for k in range(len(state)):
        total[k] += factors[k, 1] * state[k] + factors[k, 2] * x
        state[k] = factors[k, 0] * state[k] + factors[k, 1] * x


@kernel
def _read(total: Any, weights: Any) -> float:  # pragma: no cover - compiled
    value = 0.0
    for k in range(len(total)):
        value += (weights[k] * total[k]).real
        total[k] = 0.0
    return value


@kernel(parallel=True)
def _follow(
    pulses: Any,
    to_tick: Any,
    from_tick: Any,
    whole: Any,
    weights: Any,
    first: Any,
    first_tick: Any,
    per_sample: int,
    traces: Any,
) -> None:  # pragma: no cover - compiled
    """Fill each trace: fine steps while charge moves, then whole samples."""
    n_fine, length = pulses.shape[1], traces.shape[1]
    for i in prange(len(pulses)):
        state = np.zeros(len(weights), np.complex128)
        total = np.zeros(len(weights), np.complex128)
        row, j = first[i], 0
        while row < length:
            x = float(pulses[i, min(j, n_fine - 1)])
            _advance(state, total, to_tick[i], x)
            if j >= first_tick[i] and (j - first_tick[i]) % per_sample == 0:
                value = _read(total, weights)
                if row >= 0:
                    traces[i, row] = value
                row += 1
                if j >= n_fine:
                    break
            _advance(state, total, from_tick[i], x)
            j += 1
        last = float(pulses[i, n_fine - 1])
        while row < length:
            _advance(state, total, whole, last)
            value = _read(total, weights)
            if row >= 0:
                traces[i, row] = value
            row += 1
