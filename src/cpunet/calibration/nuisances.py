"""Uncertain parameters of a detector's physics: names, priors, and which are free."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from cpunet.errors import CpunetError
from cpunet.settings import Config, checked, read_values
from cpunet.simulation.fields import solve
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import BOLTZMANN_V_PER_K

Values = npt.NDArray[np.float64]


class Nuisance(Config):
    r"""A parameter of the physics, and how far it may be from its simulated value.

    The fit uses a coordinate :math:`x` that is 0 at the simulated value :math:`p_0`. The
    parameter is :math:`p = p_0 + x` (``added``), :math:`p = p_0 e^x` (``factor``) or
    :math:`p = \sqrt{p_0^2 + x}` (``square``).

    Parameters
    ----------
    name
        Name in outputs, with the unit.
    short
        Short name for the command line.
    kind
        Relation of the coordinate to the parameter.
    unit
        Unit, or the kind of a number without unit.
    prior
        Standard deviation of the coordinate before any data.
    step
        Half the difference in the coordinate between two simulations for a derivative.
    reach
        Maximum change of the coordinate for which that derivative is used.
    lowest, highest
        Range of allowed values.
    source
        Origin of the prior.
    first
        Whether it is considered before the others.
    possible
        Range of values that can be true, if narrower than what is allowed.
    field
        Field of `Detector` or `SimulationSettings`, if not the name.
    """

    name: str
    short: str
    kind: Literal["added", "factor", "square"]
    unit: str
    prior: float
    step: float
    reach: float
    lowest: float
    highest: float
    source: str
    first: bool = False
    possible: tuple[float, float] = (-math.inf, math.inf)
    field: str = ""

    def value(self, nominal: float, coordinate: float) -> float:
        """Value of the parameter at a coordinate, within the allowed range.

        Examples
        --------
        >>> factor = named("hole_velocity_low")
        >>> round(factor.value(2.0, math.log(1.1)), 6)
        2.2
        """
        scale, back = _SCALES[self.kind]
        return min(max(back(scale(nominal) + coordinate), self.lowest), self.highest)

    def coordinate(self, nominal: float, value: float) -> float:
        """Coordinate of a value."""
        scale, _ = _SCALES[self.kind]
        return scale(value) - scale(nominal)

    def slope(self, value: float) -> float:
        """Derivative of the parameter with respect to its coordinate, to convert errors."""
        if self.kind == "square":
            # near 0: the increase by a step of the coordinate
            return 0.5 / max(value, math.sqrt(self.step))
        return value if self.kind == "factor" else 1.0

    def bounds(self, nominal: float) -> tuple[float, float]:
        """Coordinates of the minimum and maximum value."""
        return self.coordinate(nominal, self.lowest), self.coordinate(nominal, self.highest)


# Scales on which a coordinate is added, and back.
_SCALES: dict[str, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "added": (float, float),
    "factor": (math.log, math.exp),
    "square": (lambda value: value**2, lambda square: math.sqrt(max(0.0, square))),
}
_TABLE: dict[str, dict[str, Any]] = read_values(Path(__file__).with_name("nuisances.yaml"))
NUISANCES = tuple(Nuisance(name=name, **row) for name, row in _TABLE.items())


def titled(text: str, *, units: bool = True) -> str:
    """Put words in place of the names of parameters in a text.

    Examples
    --------
    >>> titled("bias_V"), titled("0.94 self_repulsion", units=False)
    ('bias [V]', '0.94 self repulsion')
    """
    for nuisance in NUISANCES:
        words = nuisance.short.replace("_", " ") + units * f" {nuisance.unit}"
        text = re.sub(rf"\b{nuisance.name}\b", words, text)
    return text


def named(text: str) -> Nuisance:
    """Find a nuisance by its long or short name.

    Raises
    ------
    CpunetError
        If none has this name.

    Examples
    --------
    >>> named("temperature").name
    'temperature_K'
    """
    for nuisance in NUISANCES:
        if text.strip() in (nuisance.name, nuisance.short):
            return nuisance
    names = ", ".join(nuisance.short for nuisance in NUISANCES)
    raise CpunetError(f"{text.strip()!r}: no such parameter of the physics; these are {names}")


@dataclass(frozen=True)
class Physics:
    """A detector and its charge clouds as functions of coordinates, all 0 as simulated.

    Parameters
    ----------
    detector, settings
        Detector and settings as simulated.
    nuisances
        Parameters that may change, in the order of the coordinates.
    given
        Priors that replace the defaults: value and error by name, also of
        ``"depletion_voltage"``.
    """

    detector: Detector
    settings: SimulationSettings
    nuisances: tuple[Nuisance, ...]
    given: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def nominal(self, nuisance: Nuisance) -> float:
        """Simulated value; 1 for a factor that is not in the settings."""
        values = {**dict(self.settings), **dict(self.detector), "impurity_scale": 1.0}
        value = values[nuisance.field or nuisance.name]
        thermal = BOLTZMANN_V_PER_K * self.detector.temperature_K * 10.0  # mm V/cm
        of_words = {"siggen": 0.12, "temperature": thermal}
        return float(of_words.get(value, value))

    def values(self, coordinates: Values) -> dict[str, float]:
        """Values by name."""
        return {
            n.name: n.value(self.nominal(n), float(x))
            for n, x in zip(self.nuisances, coordinates, strict=True)
        }

    def at(self, coordinates: Values) -> tuple[Detector, SimulationSettings]:
        """Detector and settings at some coordinates. Fields at coordinate 0 stay exactly.

        Raises
        ------
        CpunetError
            If no detector can have these values.
        """
        of_detector, of_settings = self.detector.model_dump(), self.settings.model_dump()
        values = self.values(coordinates)
        for n, coordinate in zip(self.nuisances, coordinates, strict=True):
            field = n.field or n.name
            fields = of_detector if field in of_detector else of_settings
            if coordinate:
                unit = fields[field] if n.name == "impurity_factor" else 1.0
                fields[field] = unit * values[n.name]
        sizes = ", ".join(f"{name} = {value:.4g}" for name, value in values.items())
        remedy = "narrow a `prior`, or leave any of them out of `free`"
        source = f"detector {self.detector.name}: {sizes} is impossible; {remedy}"
        settings = checked(SimulationSettings, of_settings, source)
        return checked(Detector, of_detector, source), settings

    def in_own_unit(self, i: int, coordinate: float, error: float) -> tuple[float, float]:
        """Value of the parameter at position `i` at a coordinate, and its error."""
        nuisance, nominal = self.nuisances[i], self.nominal(self.nuisances[i])
        value = nuisance.value(nominal, coordinate)
        return value, float(nuisance.slope(value) * error)

    def priors(self) -> tuple[Values, Values]:
        """Centres and widths of the coordinates before any data: as given, else around 0."""
        centres = np.zeros(len(self.nuisances))
        widths = np.array([nuisance.prior for nuisance in self.nuisances])
        for i, nuisance in enumerate(self.nuisances):
            if nuisance.name in self.given:
                nominal, (value, error) = self.nominal(nuisance), self.given[nuisance.name]
                centres[i] = nuisance.coordinate(nominal, value)
                widths[i] = error / nuisance.slope(value)
        return centres, widths


DEPLETION = "depletion_voltage"
# Steps of impurity factor and tilt (1e10/cm4) for the derivatives of the depletion voltage.
_FACTOR, _TILT = 0.1, 0.01


Freedom: TypeAlias = tuple[tuple[Nuisance, ...], bool, dict[str, tuple[float, float]]]


def freedom(
    free: str | Sequence[str] = (),
    prior: Sequence[str] | Mapping[str, tuple[float, float]] = (),
) -> Freedom:
    """The free physical parameters, and prior knowledge of them, as users give them.

    Returns
    -------
    looked_at
        Parameters that can become free.
    chosen
        Whether all of them are free; if not, those that the data constrain.
    priors
        Prior value and error by name, also of ``"depletion_voltage"``.

    Raises
    ------
    CpunetError
        If a parameter is unknown, a prior is not of the form ``NAME=VALUE±ERROR``, its
        value is not allowed, or it is of a parameter that stays as simulated.

    Examples
    --------
    >>> freedom(prior=["temperature=90±0.5"])[2]
    {'temperature_K': (90.0, 0.5)}
    >>> freedom(prior=["tilt=−0.03±0.01"])[2]  # a minus sign as printed
    {'impurity_tilt_1e10_per_cm4': (-0.03, 0.01)}
    """
    texts = [free] if isinstance(free, str) else free
    parts = [part for text in texts for part in text.split(",") if part.strip()]
    chosen = tuple(dict.fromkeys(map(named, parts)))
    # another lithium layer requires new field solutions: only on request
    looked_at = chosen or tuple(n for n in NUISANCES if n.name != "li_thickness_mm")
    allowed, priors = {n.name for n in looked_at} | {DEPLETION}, {}
    if isinstance(prior, Mapping):
        prior = [f"{name}={value}±{error}" for name, (value, error) in prior.items()]
    for given in prior:
        try:
            # tables print a true minus sign
            word, *numbers = re.split("=|±|\\+/?-", given.replace("−", "-"))
            name, (value, error) = word.strip(), map(float, numbers)
        except ValueError:
            remedy = "expected NAME=VALUE±ERROR, as temperature=90±0.5"
            raise CpunetError(f"`prior` {given}: {remedy}") from None
        text = f"`prior` {name}={value:g}"
        if not (error > 0 and np.isfinite([value, error]).all()):
            raise CpunetError(f"{text}±{error:g}: expected a value, and an error above 0")
        if name != DEPLETION:
            nuisance = named(name)
            name, low, high = nuisance.name, nuisance.lowest, nuisance.highest
            if not low <= value <= high:
                limits = f"{low:g} to {high:g}"
                raise CpunetError(f"{text}: {name} can be {limits}", "give a value between")
        if name not in allowed:
            raise CpunetError(
                f"`prior` {name}: it stays as simulated",
                "name it in `free`, or leave out its prior",
            )
        priors[name] = value, error
    return looked_at, bool(chosen), priors


def depletion(physics: Physics) -> Callable[[Values], Values]:
    """Deviation of the depletion voltage from its measured value, in units of its error.

    Without a measured value among the priors the function gives no deviation.

    Raises
    ------
    CpunetError
        If a depletion voltage, as simulated, with the values of the priors, a step of the
        impurities higher, or as measured, is above the bias.
    """
    centres, _ = physics.priors()
    higher = np.array([(x.name == "impurity_factor") * x.step for x in physics.nuisances])
    measured, bias = physics.given.get(DEPLETION), physics.detector.bias_V
    needed = [] if measured is None else [measured[0]]
    for coordinates in (higher, centres, np.zeros(len(centres))):
        detector, _ = physics.at(coordinates)
        scale, tilt = detector.impurity_scale, detector.impurity_tilt_1e10_per_cm4
        superposition = solve(detector)
        at_first = superposition.depletion(scale, tilt)
        needed.append(at_first + bias - detector.bias_V)
    if max(needed) > bias:
        raise CpunetError(
            f"detector {physics.detector.name}: within the priors it depletes at "
            f"{max(needed):.0f} V, its bias is {bias:.0f} V",
            "correct bias_V or the impurities and simulate again, give a `prior` with which it "
            "depletes, or leave impurity out of `free`",
        )
    if measured is None:
        return lambda _: np.empty(0)
    wanted, error = measured
    # the factor scales neither a tilt nor a surface charge, so the voltage is not proportional
    scaled = superposition.depletion((1 + _FACTOR) * scale, tilt)
    tilted = superposition.depletion(scale, tilt + _TILT)
    with_factor, with_tilt = (scaled - at_first) / _FACTOR, (tilted - at_first) / _TILT

    def deviation(coordinates: Values) -> Values:
        values = physics.values(coordinates)
        factor = values.get("impurity_factor", 1.0)
        more = values.get("impurity_tilt_1e10_per_cm4", tilt) - tilt
        voltage = at_first + with_factor * (factor - 1) + with_tilt * more
        return np.array([(voltage - wanted) / error])

    return deviation
