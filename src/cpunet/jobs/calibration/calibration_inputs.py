"""Inputs of a calibration: a simulation with its hits, a measurement, and priors."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from cpunet.calibration.nuisances import NUISANCES, Nuisance, Physics, Values, named
from cpunet.errors import CpunetError
from cpunet.pulses.loading import (
    InputSet,
    load_measured,
    load_simulated,
    require_both_sides,
    require_same_sampling,
)
from cpunet.pulses.peaks import EnergySelection, parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes.schema import Recipe
from cpunet.simulation.clustering import MERGING_MM
from cpunet.simulation.geometry import Detector
from cpunet.simulation.hit_sources import HitFile
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulate import simulate
from cpunet.simulation.stored_simulation import StoredSimulation
from cpunet.simulation.superposition import solve

log = logging.getLogger(__name__)

DEPLETION = "depletion_voltage"
_PRIOR = re.compile(r"\s*([\w.]+)\s*=\s*([-+.\deE]+?)\s*(?:±|\+-|\+/-)\s*([.\deE+-]+)\s*")
# Steps of impurity factor and tilt (1e10/cm4) for the derivatives of the depletion voltage.
_FACTOR, _TILT = 0.1, 0.01


@dataclass(frozen=True)
class Freedom:
    """The free physical parameters, and prior knowledge of them.

    Parameters
    ----------
    free
        Free parameters; None for all those that the data constrain.
    fixed
        Names of parameters that keep their simulated values.
    priors
        Prior value and error by name, also of ``"depletion_voltage"``.
    """

    free: tuple[Nuisance, ...] | None = None
    fixed: frozenset[str] = frozenset()
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, free: str, fixed: str, given: Sequence[str]) -> Freedom:
        """Parse the options of the command line.

        Raises
        ------
        CpunetError
            If a parameter is unknown, a prior is not of the form ``NAME=VALUE±ERROR``, its
            value is not allowed, or it is of a parameter that stays as simulated.

        Examples
        --------
        >>> Freedom.of("auto", "tilt", ["temperature=90±0.5"]).priors
        {'temperature_K': (90.0, 0.5)}
        """
        chosen = None if free.strip() == "auto" else _parameters(free)
        stay = frozenset(nuisance.name for nuisance in _parameters(fixed))
        if chosen is not None:
            chosen = tuple(n for n in chosen if n.name not in stay)
            if not chosen:
                raise CpunetError(f"--free {free}: all of it is fixed; leave something free")
        freedom = cls(chosen, stay, dict(_prior(text) for text in given))
        without_use = freedom.priors.keys() - {DEPLETION, *(n.name for n in freedom.looked_at)}
        if without_use:
            raise CpunetError(
                f"--prior {min(without_use)}: it stays as simulated; name it in --free, or "
                "leave out its prior"
            )
        return freedom

    @property
    def looked_at(self) -> tuple[Nuisance, ...]:
        """Parameters that can become free."""
        if self.free is not None:
            return self.free
        # another lithium layer requires new field solutions: only on request
        return tuple(
            n for n in NUISANCES if n.name not in self.fixed and n.name != "li_thickness_mm"
        )


@dataclass(frozen=True)
class Start:
    """Starting point of a calibration: a simulation with its hits, or hits to simulate.

    Parameters
    ----------
    sim
        Output of ``cpunet simulate`` or ``cpunet stand``; None with `hits`.
    hits
        Hits of the events to simulate; None with `sim`.
    detector, settings
        Detector and settings of the simulation; with `sim`, None for those of its file.
    cluster_mm
        Distance in mm below which `hits` are merged.
    """

    sim: PulseFile | None = None
    hits: HitFile | None = None
    detector: Detector | None = None
    settings: SimulationSettings | None = None
    cluster_mm: float = MERGING_MM

    def __post_init__(self) -> None:
        if (self.sim is None) == (self.hits is None):
            raise CpunetError("give either --sim FILE, with its hits, or --hits FILE")
        if self.hits is not None and self.detector is None:
            raise CpunetError("--hits: give the --detector that they lie in")

    @property
    def files(self) -> tuple[Path | str | None, ...]:
        """Paths that are read, for `cpunet.outputs.refuse_inputs`."""
        return (*(self.sim.files if self.sim else ()), self.hits.path if self.hits else None)


@dataclass(frozen=True, eq=False)
class Sides:
    """Both sides, read and prepared, and the physics of the simulated side.

    Parameters
    ----------
    sim, data
        Prepared pulses of both sides.
    sim_path
        File of the simulated pulses with their hits.
    physics
        Initial physics of the simulation; nothing is free yet.
    stored
        Hits, one event per pulse of the file.
    selection
        Selected energies.
    temporary
        File that was simulated only as a starting point, or None.
    """

    sim: InputSet
    data: InputSet
    sim_path: Path
    physics: Physics
    stored: StoredSimulation
    selection: EnergySelection
    temporary: Path | None

    def forget(self) -> None:
        """Remove the file that was simulated only as a starting point."""
        if self.temporary is not None:
            self.temporary.unlink()


def read_sides(
    start: Start,
    data_file: PulseFile,
    recipe: Recipe,
    peak: str,
    events: int,
    seed: int,
    folder: Path,
) -> Sides:
    """Read and prepare both sides; if hits are given, simulate them first.

    Parameters
    ----------
    start, data_file, recipe, peak, events, seed
        See `cpunet.jobs.calibration.calibrate.Calibration`.
    folder
        Folder for pulses that are simulated only as a starting point.

    Raises
    ------
    CpunetError
        If an input cannot be used.
    """
    selection = parse_selection(peak, recipe.peaks)
    data = load_measured(data_file, recipe, selection)
    sim, temporary = start.sim, None
    if sim is None:
        temporary = folder / "as_simulated.lh5"
        sim = PulseFile(_simulated(start, temporary, data.dt_ns))
    stored = StoredSimulation.read(sim.path)
    simulated = load_simulated(sim, recipe, selection)
    require_same_sampling(simulated, data)
    for note in require_both_sides(simulated, data, selection):
        log.warning(note)
    # in random order, so that any first part is a representative sample
    rows = np.random.default_rng(seed).permutation(len(simulated.prepared))[:events]
    some = replace(simulated, prepared=simulated.prepared[rows])
    settings = start.settings or stored.settings
    if not np.isclose(settings.dt_ns, simulated.dt_ns):
        raise CpunetError(
            f"--settings: dt_ns = {settings.dt_ns:g}, but the pulses of {sim.path} have "
            f"{simulated.dt_ns:g}; give that"
        )
    physics = Physics(start.detector or stored.detector, settings, ())
    return Sides(some, data, sim.path, physics, stored, selection, temporary)


def _simulated(start: Start, path: Path, dt_ns: float) -> Path:
    """Simulate the pulses of hits with the given physics."""
    assert start.hits is not None
    assert start.detector is not None
    simulate(
        path,
        detector=start.detector,
        hits=start.hits,
        settings_file=start.settings or SimulationSettings(dt_ns=dt_ns),
        settings={"cluster_mm": start.cluster_mm},
    )
    return path


def known_depletion(
    physics: Physics, measured: tuple[float, float] | None
) -> Callable[[Values], Values]:
    """Deviation of the depletion voltage from its measured value, in units of its error.

    Parameters
    ----------
    physics
        Physics to which the coordinates belong.
    measured
        Measured voltage and its error in V; None gives no deviation.
    """
    if measured is None:
        return lambda _: np.empty(0)
    wanted, error = measured
    superposition, detector = solve(physics.detector), physics.detector
    scale, tilt = detector.impurity_scale, detector.impurity_tilt_1e10_per_cm4
    at_first = superposition.depletion_V(scale, tilt)
    # the factor scales neither a tilt nor a surface charge, so the voltage is not proportional
    scaled = superposition.depletion_V((1 + _FACTOR) * scale, tilt)
    tilted = superposition.depletion_V(scale, tilt + _TILT)
    with_factor, with_tilt = (scaled - at_first) / _FACTOR, (tilted - at_first) / _TILT

    def known(coordinates: Values) -> Values:
        values = physics.values(coordinates)
        factor = values.get("impurity_factor", 1.0)
        more = values.get("impurity_tilt_1e10_per_cm4", tilt) - tilt
        voltage = at_first + with_factor * (factor - 1) + with_tilt * more
        return np.array([(voltage - wanted) / error])

    return known


def _parameters(text: str) -> tuple[Nuisance, ...]:
    names = [part for part in text.split(",") if part.strip()]
    return tuple(dict.fromkeys(named(name) for name in names))


def _prior(text: str) -> tuple[str, tuple[float, float]]:
    found = _PRIOR.fullmatch(text)
    expected = f"--prior {text}: expected NAME=VALUE±ERROR, as temperature=90±0.5"
    if found is None:
        raise CpunetError(expected)
    try:
        value, error = float(found[2]), float(found[3])
    except ValueError:
        raise CpunetError(expected) from None
    if not (error > 0 and np.isfinite([value, error]).all()):
        raise CpunetError(expected)
    if found[1] == DEPLETION:
        return DEPLETION, (value, error)
    nuisance = named(found[1])
    if not nuisance.lowest <= value <= nuisance.highest:
        raise CpunetError(
            f"--prior {text}: {nuisance.name} can be {nuisance.lowest:g} to "
            f"{nuisance.highest:g}; give a value between"
        )
    return nuisance.name, (value, error)
