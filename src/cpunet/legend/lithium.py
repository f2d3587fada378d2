"""Charge of the lithium layer, which production simulations look up.

The n+ layer has no field, so holes released there diffuse. Those that reach its inner boundary
are collected with a delay; those that recombine near the surface or reach it are lost (D. Dai
et al., arXiv:2207.11902; P. Zhang et al., arXiv:2511.02513; reboost's surface model). Only the
probability of having reached the boundary is needed. It obeys the backward diffusion equation,
so one solution covers all depths, and its modes cover all times.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.linalg

import cpunet
from cpunet.errors import CpunetError
from cpunet.legend.library_files import put_column
from cpunet.outputs import refuse_existing
from cpunet.pulses.writing import written_hdf5

Values = npt.NDArray[np.float64]

NODES = 400  # grid intervals across the layer
TABLE_NS, STEP_MM = 10_000, 0.01  # of tables, as of those of reboost
MM2_PER_NS = 1e-7  # 1 cm²/s in mm²/ns


@dataclass(frozen=True)
class LithiumLayer:
    """Properties of the n+ layer that determine its charge collection.

    Parameters
    ----------
    thickness_mm
        Distance in mm from the surface to the depth where all charge is collected.
    recombination_depth_mm
        Depth in mm down to which charge recombines.
    lifetime_ns
        Lifetime of the charge in ns where it recombines.
    diffusion_cm2_per_s
        Diffusion constant of the holes in cm²/s: k T / e times a mobility of 4e4 cm²/Vs is 300
        at 90 K.

    Raises
    ------
    CpunetError
        If a number is out of range or the recombination depth exceeds the thickness.
    """

    thickness_mm: float
    recombination_depth_mm: float = 0.5
    lifetime_ns: float = 500.0
    diffusion_cm2_per_s: float = 290.0

    def __post_init__(self) -> None:
        for name in ("thickness_mm", "lifetime_ns", "diffusion_cm2_per_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise CpunetError(f"lithium layer: {name} is {value}; give a number above 0")
        if not 0 <= self.recombination_depth_mm <= self.thickness_mm:
            raise CpunetError(
                f"lithium layer: charge recombines down to {self.recombination_depth_mm} mm of "
                f"{self.thickness_mm} mm; give 0 up to its thickness"
            )


def arrived(layer: LithiumLayer, depth_mm: npt.ArrayLike, time_ns: npt.ArrayLike) -> Values:
    """Fraction of the charge that has reached the inner boundary.

    Parameters
    ----------
    layer
        Properties of the layer.
    depth_mm
        Depths in mm at which charge is released. Beyond the layer all of it arrives at once.
    time_ns
        Times in ns since the release, 0 or later.

    Returns
    -------
    numpy.ndarray
        Shape (depths, times), between 0 and 1.

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
    # fraction of each cell in which charge recombines
    share = np.clip((layer.recombination_depth_mm - inner) / step + 0.5, 0, 1)
    diagonal = -2 * rate - share / layer.lifetime_ns
    values, modes = scipy.linalg.eigh_tridiagonal(diagonal, np.full(NODES - 2, rate))
    # the steady state: its only source is the inner boundary, where the probability is 1
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


@dataclass(frozen=True)
class LithiumTable:
    """A table of delayed charge.

    Parameters
    ----------
    path
        The file.
    dead_mm
        Depth from which half of the charge arrives.
    half_ns
        Time after which half of that has arrived.
    """

    path: Path
    dead_mm: float
    half_ns: float

    def __str__(self) -> str:
        return (
            f"{self.path}: half of the charge from {self.dead_mm:.2f} mm arrives, half of that "
            f"within {self.half_ns:.0f} ns"
        )


def lithium_table(layer: LithiumLayer, out: str | Path, *, force: bool = False) -> LithiumTable:
    """Tabulate the charge that arrives from a lithium layer, for reboost's surface model.

    The LH5 file contains ``struct{depth, dt, t0, arrived, activeness}``: depths in mm from the
    surface, shares of the charge that have arrived at each nanosecond, shape (times, depths)
    as `reboost.hpge.psd.make_convolved_surface_library` takes them, and the final shares.

    Raises
    ------
    CpunetError
        If the layer is thinner than the spacing of the depths, or the file exists (without
        `force`) or cannot be written.
    """
    out = Path(out)
    refuse_existing(out, force=force)
    if layer.thickness_mm < STEP_MM:
        raise CpunetError(
            f"depths every {STEP_MM} mm in a layer of {layer.thickness_mm} mm; give a thicker "
            "one"
        )
    depth = STEP_MM * np.arange(round(layer.thickness_mm / STEP_MM))
    time = np.arange(TABLE_NS, dtype=float)
    share = arrived(layer, depth, time)
    arrays = {
        "depth": (depth, "mm"),
        "dt": (np.array(1.0), "ns"),
        "t0": (np.array(0.0), "ns"),
        "arrived": (share.T.copy(), ""),
        "activeness": (share[:, -1].copy(), ""),
    }
    with written_hdf5(out) as (made, _):
        group = made.create_group("lithium")
        for key, (values, units) in arrays.items():
            put_column(group, key, values, units)
        group.attrs["datatype"] = f"struct{{{','.join(arrays)}}}"
        group.attrs["cpunet"] = json.dumps({"cpunet": cpunet.__version__} | asdict(layer))
    ends = share[:, -1]
    dead = float(np.interp(0.5, ends, depth))
    middle = arrived(layer, [dead], time)[0]
    half = float(np.interp(0.5 * middle[-1], middle, time))
    return LithiumTable(out, dead, half)
