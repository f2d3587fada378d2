"""The hits stored with simulated pulses: a flat LH5 table with one row per hit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened, text_attribute
from cpunet.simulation.hit_readers.steps import Steps, Units, whole_numbers
from cpunet.simulation.hits import Hits

TABLE = "geds/hits"
_EVENTS = "geds/sim/event_number"
_AXES = ("x", "y", "z")


def hit_columns(hits: Hits) -> dict[str, tuple[npt.NDArray[Any], str]]:
    """Columns of the table as name → (values, units), in the order of the events.

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
    """Read the steps of the table, in the frame of the crystal in which they were written.

    Raises
    ------
    CpunetError
        If the table cannot be read, lacks a column or a unit, has columns of different
        lengths, or has no hits for an event whose pulse is in the file.
    """
    values, named = {}, {}
    with opened(path) as file:
        for name in ("event_number", *_AXES, "edep"):
            column = file.get(f"{TABLE}/{name}")
            if column is None:
                raise CpunetError(f"{path}: {TABLE} has no column {name}; write the file again")
            if not is_column(column):
                raise CpunetError(f"{path}: {TABLE}/{name} holds no numbers; write it again")
            values[name] = np.asarray(column[()])
            named[name] = text_attribute(column, "units")
        pulses = file.get(_EVENTS)
        events = np.asarray(pulses[()]) if is_column(pulses) else np.empty(0, np.int64)
    if len({column.shape for column in values.values()}) != 1:
        raise CpunetError(f"{path}: columns of {TABLE} differ in length; is it truncated?")
    number = whole_numbers(path, f"{TABLE}/event_number", values["event_number"])
    without = ~np.isin(events, number)
    if without.any():
        raise CpunetError(
            f"{path}: {TABLE} has no hit of event {events[without][0]}; simulate it again"
        )
    position = [values[a] * units.factor(a, path, f"{TABLE}/{a}", named[a]) for a in _AXES]
    energy = values["edep"] * units.factor("edep", path, f"{TABLE}/edep", named["edep"])
    return Steps(number, np.stack(position, axis=1), energy)
