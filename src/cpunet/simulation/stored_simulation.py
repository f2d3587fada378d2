"""Read detector, settings and hits of simulated pulses, to simulate them again."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from cpunet.errors import CpunetError
from cpunet.hdf5_files import is_column, opened
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_files import HIT_TABLE, read_hits
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings

_PULSES = "geds/sim"


@dataclass(frozen=True, eq=False)
class StoredSimulation:
    """Physics and hits of the pulses in a file of ``cpunet simulate`` or of a test stand.

    Parameters
    ----------
    detector, settings
        Detector and settings of the simulation, with the period of the pulses in the file.
    hits
        Merged hits, one event per pulse, in the order of the pulses.
    """

    detector: Detector
    settings: SimulationSettings
    hits: Hits

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a file.

        Hits of events that have no pulse in the file are left out.

        Raises
        ------
        CpunetError
            If the file cannot be read, does not record how it was made, or lacks the hits of
            a pulse.
        """
        file = Path(path)
        with opened(file) as content:
            text = content[_PULSES].attrs.get("simulation") if _PULSES in content else None
            if text is None or HIT_TABLE not in content:
                raise CpunetError(
                    f"{file}: no {_PULSES} with its simulation and {HIT_TABLE} beside it; give "
                    "an output of cpunet simulate or of a test stand"
                )
            column = content.get(f"{_PULSES}/event_number")
            numbers = np.asarray(column[()]) if is_column(column) else np.empty(0)
        try:
            made = json.loads(text)
            detector = Detector.model_validate(made["detector"])
            settings = SimulationSettings.model_validate(made["settings"])
        except (KeyError, TypeError, ValueError) as error:
            raise CpunetError(
                f"{file}: what {_PULSES} tells of its simulation cannot be used by this "
                "version; simulate it again"
            ) from error
        if len(np.unique(numbers)) < len(numbers):
            raise CpunetError(
                f"{file}: several pulses have the same event_number; simulate them again"
            )
        hits = read_hits(file).of_events(numbers)
        missing = np.diff(hits.offsets) == 0
        if missing.any():
            raise CpunetError(
                f"{file}: {HIT_TABLE} has no hit of event {numbers[np.argmax(missing)]}; "
                "simulate it again"
            )
        return cls(detector, settings, hits)
