"""The hits that are kept beside simulated pulses: a flat LH5 table, a row per hit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lh5
import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.simulation.hit_readers.steps import Steps, Units
from cpunet.simulation.hits import Hits

TABLE = "geds/hits"
_AXES = ("x", "y", "z")


def hit_columns(hits: Hits) -> dict[str, tuple[npt.NDArray[Any], str]]:
    """Columns of the table, name → (values, units), in the order of the events.

    Examples
    --------
    >>> hits = Hits.of([[0, 0, 10], [5, 0, 12]], [1000, 592.5], [0, 2], [7])
    >>> columns = hit_columns(hits)
    >>> list(columns), columns["event_number"][0]
    (['event_number', 'x', 'y', 'z', 'edep'], array([7, 7]))
    """
    return {
        "event_number": (np.repeat(hits.event_number, np.diff(hits.offsets)), ""),
        "x": (hits.x_mm, "mm"),
        "y": (hits.y_mm, "mm"),
        "z": (hits.z_mm, "mm"),
        "edep": (hits.edep_kev, "keV"),
    }


def read_hit_table(path: Path, units: Units) -> Steps:
    """Steps of the table, in the crystal's frame in which they were written.

    Raises
    ------
    CpunetError
        If the table cannot be read, lacks a column or a unit, or its columns differ
        in length.
    """
    try:
        table = lh5.read(TABLE, str(path))
    # truncated and foreign files fail in as many ways as the library has layers
    except Exception as error:
        raise CpunetError(f"{path}: {TABLE} cannot be read; is the file truncated?") from error
    missing = [name for name in ("event_number", *_AXES, "edep") if name not in table]
    if missing:
        raise CpunetError(f"{path}: {TABLE} has no column {missing[0]}; write the file again")
    values = {name: np.asarray(table[name].nda) for name in ("event_number", *_AXES, "edep")}
    if len({column.shape for column in values.values()}) != 1:
        raise CpunetError(f"{path}: columns of {TABLE} differ in length; is it truncated?")
    named = {name: table[name].attrs.get("units") for name in (*_AXES, "edep")}
    position = [values[a] * units.to_mm(path, f"{TABLE}/{a}", named[a]) for a in _AXES]
    energy = values["edep"] * units.to_kev(path, f"{TABLE}/edep", named["edep"])
    return Steps(values["event_number"].astype(np.int64), np.stack(position, axis=1), energy)
