"""Simulate the hits of stored pulses again, with other physics, as needed for a calibration."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from cpunet.errors import CpunetError
from cpunet.hdf5_files import opened
from cpunet.simulation.fields import NOT_IN_PARTS, Superposition, solve, superposed_fields
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_files import read_hits
from cpunet.simulation.hit_tables import HIT_TABLE
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import EventPulses, Simulator

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
                    f"{file}: no {_PULSES} with its simulation, or no {HIT_TABLE}; give "
                    "an output of cpunet simulate or of a test stand"
                )
            numbers = np.asarray(content[f"{_PULSES}/event_number"][()])
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
        if (without := np.diff(hits.offsets) == 0).any():
            raise CpunetError(
                f"{file}: {HIT_TABLE} has no hit of event {hits.event_number[without][0]}; "
                "simulate it again"
            )
        return cls(detector, settings, hits)


# Maximum number of time steps that a drift step of quick pulses replaces.
_QUICK_STRIDE = 5
# Maximum number of detector shapes (such as lithium thicknesses) whose potentials are held.
_MAX_SHAPES = 4


class SameHits:
    """Hits of a set of events, for repeated simulation with other physics.

    Another temperature, bias, velocity, cloud or trapping, or another scale or tilt of the
    impurities, needs no new solution of the fields. Another shape of the active germanium,
    such as another ``li_thickness``, needs one (seconds, then cached).

    Parameters
    ----------
    hits
        Merged events in the frame of the crystal.

    Examples
    --------
    >>> from cpunet.simulation.geometry_readers import read_detector
    >>> hits = Hits.of([[20, 0, 40], [0, 9, 12]], [2600, 14.5], [0, 2])
    >>> same, settings = SameHits(hits), SimulationSettings()
    >>> cold, warm = (
    ...     same.simulate(read_detector("ppc", [f"temperature_K={t}"]), settings).waveforms
    ...     for t in (85, 95)
    ... )
    >>> bool(warm.sum() < cold.sum())  # warm charges are slower
    True
    """

    def __init__(self, hits: Hits) -> None:
        self._hits = hits
        self._solutions: dict[str, Superposition] = {}

    def simulate(
        self,
        detector: Detector,
        settings: SimulationSettings,
        *,
        quick: bool = False,
        most: int | None = None,
    ) -> EventPulses:
        """Pulses of the events with the physics of `detector` and `settings`.

        Parameters
        ----------
        detector, settings
            Detector and simulation settings.
        quick
            Whether to take longer steps, for differences between two sets of physics: its
            errors are nearly equal in both. See benchmarks/same_hits.py for accuracy and speed.
        most
            Number of first events to simulate; None for all.

        Raises
        ------
        CpunetError
            If the detector is not depleted, or a hit is not finite.
        """
        key = detector.fingerprint(exclude=NOT_IN_PARTS)
        if key not in self._solutions:
            if len(self._solutions) == _MAX_SHAPES:
                # keep the first, with which all others are compared
                del self._solutions[list(self._solutions)[1]]
            self._solutions[key] = solve(detector)
        fields = superposed_fields(self._solutions[key], detector, depletion=False)
        steps = settings.steps_per_sample if quick else 1
        stride = max(n for n in range(1, _QUICK_STRIDE + 1) if steps % n == 0)
        simulator = Simulator(detector, settings, fields=fields, stride=stride)
        return simulator.events(self._hits[:most])
