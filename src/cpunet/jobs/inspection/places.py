"""Ideal pulses of deposits on a grid of positions in a crystal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cpunet.errors import CpunetError
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.simulation.simulation_settings import load_settings
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import Values
from cpunet.pulses.preparation import Rejection, prepare
from cpunet.recipes.schema import Recipe
from cpunet.simulation.fields import compute_fields
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.signals import Signals, hit_signals

QUIET = Monitor()
# Energy of each deposit, that of a double-escape event; matters only for self-repulsion.
ENERGY_KEV = 1592.5
IN_CONTACT = "in a contact or its dead layer"
NO_FIELD = "in germanium without a field"
NOT_COLLECTED = "charge not collected within the record"
_AREA_POINTS = 400  # grid points along the longer side, to measure the area


@dataclass(frozen=True, eq=False)
class Places:
    """Grid points in the crystal on the half-plane y = 0, with their prepared ideal pulses.

    Parameters
    ----------
    r_mm, z_mm
        Coordinates in mm, shape ``(points,)``, on a grid with spacing `step_mm`.
    missing
        Reason why a grid point has no pulse, ``""`` where it has one.
    windows
        Prepared window of each grid point with a pulse.
    """

    r_mm: Values
    z_mm: Values
    step_mm: float
    missing: tuple[str, ...]
    windows: FloatArray


def settings_at(dt_ns: float, settings: SimulationSettings | None) -> SimulationSettings:
    """Settings of a simulation with sampling period `dt_ns`; others keep their defaults.

    Raises
    ------
    CpunetError
        If `settings` contain another ``dt_ns``, or a time step that does not divide it.
    """
    values = settings.model_dump(exclude_unset=True) if settings else {}
    if not np.isclose(values.get("dt_ns", dt_ns), dt_ns):
        raise CpunetError(
            f"settings: dt_ns = {values['dt_ns']:g}, but the run was trained on pulses "
            f"sampled every {dt_ns:g} ns; leave dt_ns out"
        )
    step_ns = dt_ns / max(1, round(dt_ns))
    return load_settings(values={"step_ns": step_ns} | values | {"dt_ns": dt_ns})


def crystal_grid(detector: Detector, points: int) -> tuple[Values, Values, float]:
    """Points of a square grid inside the crystal: r, z and the spacing, all in mm.

    Parameters
    ----------
    detector
        Detector; its lithium layer is part of the crystal, its ditch and bore are not.
    points
        Approximate number of grid points.

    Examples
    --------
    >>> from cpunet.simulation.geometry_readers import read_detector
    >>> r, z, step = crystal_grid(read_detector("icpc"), 400)
    >>> len(r), step
    (401, 2.9)
    """
    fine = max(detector.crystal_length, detector.crystal_radius) / _AREA_POINTS
    area = len(_inside(detector, fine)[0]) * fine**2
    step = float(f"{np.sqrt(area / points):.2g}")
    return *_inside(detector, step), step


def _inside(detector: Detector, step: float) -> tuple[Values, Values]:
    r, z = (
        side.ravel()
        for side in np.meshgrid(
            np.arange(step / 2, detector.crystal_radius, step),
            np.arange(step / 2, detector.crystal_length, step),
        )
    )
    inside = detector.inside(r, z)
    return r[inside], z[inside]


def place_pulses(
    detector: Detector,
    recipe: Recipe,
    settings: SimulationSettings,
    points: int,
    monitor: Monitor = QUIET,
) -> Places:
    """Simulate and prepare the pulse of a single deposit at each grid point.

    Raises
    ------
    CpunetError
        If the detector is not depleted.
    """
    with monitor.stage(f"Fields of {detector.name}"):
        fields = compute_fields(detector)
    r, z, step = crystal_grid(detector, points)
    with monitor.stage("Pulses by place"):
        signals = hit_signals(fields, r, np.zeros_like(r), z, ENERGY_KEV, settings)
        prepared = prepare(
            Pulses.of(signals.waveforms, dt_ns=signals.dt_ns),
            recipe.preparation,
            "simulated",
        )
    missing = _why_missing(detector, r, z, signals)
    kept = np.array([not why for why in missing])
    for i in np.flatnonzero(kept & (prepared.codes != Rejection.ACCEPTED)):
        missing[i] = f"not prepared: {Rejection(prepared.codes[i]).label.replace('_', ' ')}"
    rows = kept[prepared.index]
    return Places(r, z, step, tuple(missing), prepared.pulses.waveforms[rows])


def _why_missing(detector: Detector, r: Values, z: Values, signals: Signals) -> list[str]:
    active = detector.active(r, z)
    reasons = np.where(signals.collected, "", NOT_COLLECTED)
    reasons = np.where(signals.valid, reasons, NO_FIELD)
    return [str(why) for why in np.where(active | signals.valid, reasons, IN_CONTACT)]
