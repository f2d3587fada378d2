"""Tables of the charge collected from a lithium layer, for reboost's surface model."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

import cpunet
from cpunet.errors import CpunetError
from cpunet.jobs.simulation.library_arrays import put_column
from cpunet.outputs import refuse_existing, written_aside
from cpunet.pulses.writing import FileInTheMaking
from cpunet.simulation.lithium import LithiumLayer, arrived

LENGTH_NS, STEP_MM = 10_000, 0.01  # as in the tables of reboost


def write_lithium_library(
    layer: LithiumLayer,
    out: Path,
    *,
    force: bool = False,
) -> dict[str, float]:
    """Tabulate the charge that arrives from a lithium layer by depth and time.

    The LH5 file contains ``struct{depth, dt, t0, arrived, activeness}``: depths in mm from the
    surface, shares of the charge that have arrived at each nanosecond, shape (times, depths)
    as `reboost.hpge.psd.make_convolved_surface_library` takes them, and the final shares.

    Parameters
    ----------
    layer
        Lithium layer.
    force
        Whether to replace an existing file.

    Returns
    -------
    dict
        ``dead_mm``, the depth from which half of the charge arrives, and ``half_ns``, the time
        after which half of that has arrived.

    Raises
    ------
    CpunetError
        If the layer is thinner than the spacing of the depths, or the file cannot be written.
    """
    refuse_existing(out, force=force)
    if layer.thickness_mm < STEP_MM:
        raise CpunetError(
            f"depths every {STEP_MM} mm in a layer of {layer.thickness_mm} mm; give a thicker "
            "one"
        )
    depth = STEP_MM * np.arange(round(layer.thickness_mm / STEP_MM))
    time = np.arange(LENGTH_NS, dtype=float)
    share = arrived(layer, depth, time)
    arrays = {
        "depth": (depth, "mm"),
        "dt": (np.array(1.0), "ns"),
        "t0": (np.array(0.0), "ns"),
        "arrived": (share.T.copy(), ""),
        "activeness": (share[:, -1].copy(), ""),
    }
    with written_aside(out) as aside, FileInTheMaking(aside, out) as made:
        group = made.h5.create_group("lithium")
        for key, (values, units) in arrays.items():
            put_column(group, key, values, units)
        group.attrs["datatype"] = f"struct{{{','.join(arrays)}}}"
        group.attrs["cpunet"] = json.dumps({"cpunet": cpunet.__version__} | asdict(layer))
    ends = share[:, -1]
    dead = float(np.interp(0.5, ends, depth))
    middle = arrived(layer, [dead], time)[0]
    return {"dead_mm": dead, "half_ns": float(np.interp(0.5 * middle[-1], middle, time))}
