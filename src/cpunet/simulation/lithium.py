"""Delayed charge from the lithium layer: diffusion in one dimension, with recombination.

In the n+ layer there is no field. Holes that are set free there diffuse; those that come to its
inner boundary are collected with a delay, those that recombine near the surface or come to it
are lost (D. Dai et al., arXiv:2207.11902; P. Zhang et al., arXiv:2511.02513; reboost's surface
model). All that is asked for is the probability to have arrived: it obeys the diffusion
equation backwards, so that one solution holds for all depths, and its modes for all times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.linalg

from cpunet.errors import CpunetError

Values = npt.NDArray[np.float64]

NODES = 400  # of the layer
MM2_PER_NS = 1e-7  # in one cm² per s


@dataclass(frozen=True)
class LithiumLayer:
    """What happens to charge in the n+ layer.

    Parameters
    ----------
    thickness_mm
        From the surface to where all charge is collected.
    recombination_depth_mm
        How deep charge recombines.
    lifetime_ns
        There.
    diffusion_cm2_per_s
        Constant of the holes: k T / e times a mobility of 4e4 cm²/Vs is 300 at 90 K.

    Raises
    ------
    CpunetError
        If a number is not above 0 or the layer is thinner than where charge recombines.
    """

    thickness_mm: float
    recombination_depth_mm: float = 0.5
    lifetime_ns: float = 500.0
    diffusion_cm2_per_s: float = 290.0

    def __post_init__(self) -> None:
        numbers = {
            "thickness_mm": self.thickness_mm,
            "lifetime_ns": self.lifetime_ns,
            "diffusion_cm2_per_s": self.diffusion_cm2_per_s,
        }
        for name, value in numbers.items():
            if not (math.isfinite(value) and value > 0):
                raise CpunetError(f"lithium layer: {name} is {value}; give a number above 0")
        if not 0 <= self.recombination_depth_mm <= self.thickness_mm:
            raise CpunetError(
                f"lithium layer: charge recombines down to {self.recombination_depth_mm} mm of "
                f"{self.thickness_mm} mm; give 0 up to its thickness"
            )


def arrived(layer: LithiumLayer, depth_mm: npt.ArrayLike, time_ns: npt.ArrayLike) -> Values:
    """Share of a charge that has come to the inner boundary.

    Parameters
    ----------
    layer
        Its numbers.
    depth_mm
        Where charge is set free, from the surface; deeper than the layer all is there at once.
    time_ns
        Times after that, 0 or later.

    Returns
    -------
    numpy.ndarray
        Shape (depths, times), 0 … 1.

    Examples
    --------
    >>> layer = LithiumLayer(1.0, recombination_depth_mm=0.0)
    >>> arrived(layer, [0.0, 0.25, 1.0], [1e6]).round(3).ravel().tolist()
    [0.0, 0.25, 1.0]
    """
    depth, time = np.atleast_1d(np.asarray(depth_mm, float)), np.asarray(time_ns, float)
    step = layer.thickness_mm / NODES
    inner = step * np.arange(1, NODES)
    rate = layer.diffusion_cm2_per_s * MM2_PER_NS / step**2
    # where charge recombines, in shares of a cell
    share = np.clip((layer.recombination_depth_mm - inner) / step + 0.5, 0, 1)
    diagonal = -2 * rate - share / layer.lifetime_ns
    values, modes = scipy.linalg.eigh_tridiagonal(diagonal, np.full(NODES - 2, rate))
    # fed from the boundary alone, where the probability is 1
    end = -(modes / values) @ (rate * modes[-1])
    weights = modes * (modes.T @ end)
    nodes = np.concatenate([[0.0], inner, [layer.thickness_mm]])
    place = np.clip(depth, 0, layer.thickness_mm) / step
    low = np.minimum(place.astype(int), NODES - 1)
    part = place - low
    padded = np.concatenate([np.zeros((1, len(values))), weights, np.zeros((1, len(values)))])
    ends = np.concatenate([[0.0], end, [1.0]])
    here = (1 - part)[:, None] * padded[low] + part[:, None] * padded[low + 1]
    final = np.interp(depth, nodes, ends)
    there = final[:, None] - here @ np.exp(values[:, None] * time.reshape(-1))
    return np.asarray(np.clip(there, 0, 1), np.float64)


def delayed(charge: npt.NDArray[np.floating], share: Values) -> npt.NDArray[np.float32]:
    """Pulses of charge that comes to the boundary little by little.

    Parameters
    ----------
    charge
        Pulses of charge set free at the boundary, shape (n, samples).
    share
        What has arrived at each sample, shape (n, samples) or (samples,).

    Returns
    -------
    numpy.ndarray
        Float32 (n, samples), in units of the charge set free in the layer.
    """
    n_samples = charge.shape[1]
    coming = np.diff(np.broadcast_to(share, charge.shape), axis=1, prepend=0)
    length = scipy.fft.next_fast_len(2 * n_samples, real=True)
    spectra = scipy.fft.rfft(charge.astype(float), length) * scipy.fft.rfft(coming, length)
    return np.asarray(scipy.fft.irfft(spectra, length)[:, :n_samples], np.float32)
