"""What is free in a calibration, and what is known before: priors and a depletion voltage."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cpunet.calibration.nuisances import NUISANCES, Nuisance, Physics, Values, named
from cpunet.errors import CpunetError
from cpunet.simulation.fields import solve

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
    def of(
        cls,
        free: str | Sequence[str] = (),
        fix: str | Sequence[str] = (),
        prior: Sequence[str] | Mapping[str, tuple[float, float]] = (),
    ) -> Freedom:
        """What is free, from names and priors as users give them.

        Raises
        ------
        CpunetError
            If a parameter is unknown, a prior is not of the form ``NAME=VALUE±ERROR``, its
            value is not allowed, or it is of a parameter that stays as simulated.

        Examples
        --------
        >>> Freedom.of(fix="tilt", prior=["temperature=90±0.5"]).priors
        {'temperature_K': (90.0, 0.5)}
        """
        chosen, stay = _parameters(free), frozenset(n.name for n in _parameters(fix))
        kept = tuple(n for n in chosen if n.name not in stay)
        if chosen and not kept:
            names = ", ".join(n.name for n in chosen)
            raise CpunetError(f"`free`: all of it ({names}) is fixed", "leave something free")
        given = prior.items() if isinstance(prior, Mapping) else map(_split, prior)
        priors = dict(_prior(name, *of_name) for name, of_name in given)
        freedom = cls(kept or None, stay, priors)
        without_use = priors.keys() - {DEPLETION, *(n.name for n in freedom.looked_at)}
        if without_use:
            raise CpunetError(
                f"`prior` {min(without_use)}: it stays as simulated",
                "name it in `free`, or leave out its prior",
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


def require_depletion(physics: Physics, given: Mapping[str, tuple[float, float]]) -> None:
    """Refuse a detector that is not depleted where its physics begin to be varied.

    Raises
    ------
    CpunetError
        If a depletion voltage, as simulated, with the values of the priors, one step of the
        impurities higher, or as measured, is above the bias.
    """
    centres, _ = physics.priors(given)
    higher = np.array([(x.name == "impurity_factor") * x.step for x in physics.nuisances])
    needed, bias = [], physics.detector.bias_V
    for coordinates in (np.zeros(len(centres)), higher, centres):
        detector, _ = physics.at(coordinates)
        scale, tilt = detector.impurity_scale, detector.impurity_tilt_1e10_per_cm4
        needed.append(solve(detector).depletion_V(scale, tilt) + bias - detector.bias_V)
    if DEPLETION in given:
        needed.append(given[DEPLETION][0])
    if max(needed) > bias:
        raise CpunetError(
            f"detector {physics.detector.name}: within the priors it depletes at "
            f"{max(needed):.0f} V, its bias is {bias:.0f} V",
            "correct bias_V or the impurities and simulate again, give a `prior` with which it "
            "depletes, or `fix` impurity",
        )


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


def _parameters(names: str | Sequence[str]) -> tuple[Nuisance, ...]:
    texts = [names] if isinstance(names, str) else names
    parts = [part for text in texts for part in text.split(",") if part.strip()]
    return tuple(dict.fromkeys(named(name) for name in parts))


def _split(text: str) -> tuple[str, tuple[float, float]]:
    found = _PRIOR.fullmatch(text)
    try:
        if found is not None:
            return found[1], (float(found[2]), float(found[3]))
    except ValueError:
        pass
    raise CpunetError(f"`prior` {text}: expected NAME=VALUE±ERROR, as temperature=90±0.5")


def _prior(name: str, value: float, error: float) -> tuple[str, tuple[float, float]]:
    value, error = float(value), float(error)
    if not (error > 0 and np.isfinite([value, error]).all()):
        raise CpunetError(
            f"`prior` {name}={value:g}±{error:g}: expected a value, and an error above 0"
        )
    if name == DEPLETION:
        return DEPLETION, (value, error)
    nuisance = named(name)
    if not nuisance.lowest <= value <= nuisance.highest:
        raise CpunetError(
            f"`prior` {name}={value:g}: {nuisance.name} can be {nuisance.lowest:g} to "
            f"{nuisance.highest:g}",
            "give a value between",
        )
    return nuisance.name, (value, error)
