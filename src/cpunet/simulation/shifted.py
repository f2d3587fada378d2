"""A detector that deviates from its simulation, as a real one does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from cpunet.settings import Config, checked, key_values, read_values
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import SimulationSettings

_SHIFTS = Path(__file__).parent / "shifts"

Number = Annotated[float, Field(allow_inf_nan=False)]
Factor = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Shift(Config):
    """Deviations of a detector and its charge clouds from their simulation.

    There are none by default.

    Parameters
    ----------
    temperature_K, bias_V, li_thickness_mm, impurity_tilt_1e10_per_cm4
        Offsets added to the values of the detector.
    impurity_factor
        Factor of all impurities.
    electron_velocity_low_factor, electron_velocity_high_factor, \
hole_velocity_low_factor, hole_velocity_high_factor
        Factors of the same settings.
    electron_trapping_per_us, hole_trapping_per_us
        Offsets added to the same settings.
    cloud_fwhm_mm, diffusion_constant, self_repulsion
        Replacements of the same settings. None keeps them.

    Examples
    --------
    >>> from cpunet.simulation.geometry_readers import read_detector
    >>> shift = Shift(temperature_K=1.5, hole_velocity_low_factor=0.95)
    >>> shift.detector(read_detector("icpc")).temperature_K
    91.5
    >>> shift.settings(SimulationSettings()).hole_velocity_low_factor
    0.95
    """

    switches = ("self_repulsion",)

    temperature_K: Number = 0.0
    bias_V: Number = 0.0
    impurity_factor: Factor = 1.0
    impurity_tilt_1e10_per_cm4: Number = 0.0
    li_thickness_mm: Number = 0.0
    electron_velocity_low_factor: Factor = 1.0
    electron_velocity_high_factor: Factor = 1.0
    hole_velocity_low_factor: Factor = 1.0
    hole_velocity_high_factor: Factor = 1.0
    electron_trapping_per_us: Number = 0.0
    hole_trapping_per_us: Number = 0.0
    cloud_fwhm_mm: Number | None = None
    diffusion_constant: Number | Literal["temperature", "siggen"] | None = None
    self_repulsion: Number | None = None

    @classmethod
    def of(cls, parts: Mapping[str, Any] | Iterable[str | Path]) -> Shift:
        """Combine ``"default"``, YAML files and ``"KEY=VALUE"``. Later ones take precedence.

        Raises
        ------
        CpunetError
            If a file cannot be read, or a key or value is not allowed.

        Examples
        --------
        >>> Shift.of(["temperature_K=2", "self_repulsion=0.5"]).self_repulsion
        0.5
        """
        if isinstance(parts, Mapping):
            return checked(cls, key_values(parts), "shift")
        values: dict[str, Any] = {}
        for part in map(str, parts):
            values |= key_values([part]) if "=" in part else read_values(part, _SHIFTS)
        return checked(cls, values, "shift")

    def detector(self, detector: Detector) -> Detector:
        """Shifted version of a simulated detector.

        Raises
        ------
        CpunetError
            If the shifted detector is invalid.
        """
        values = detector.model_dump()
        values["impurity_scale"] *= self.impurity_factor
        values["temperature_K"] += self.temperature_K
        values["bias_V"] += self.bias_V
        values["li_thickness"] += self.li_thickness_mm
        values["impurity_tilt_1e10_per_cm4"] += self.impurity_tilt_1e10_per_cm4
        return checked(Detector, values, f"detector {detector.name}, shifted")

    def settings(self, settings: SimulationSettings) -> SimulationSettings:
        """Shifted version of the simulation settings.

        Raises
        ------
        CpunetError
            If a value is outside the allowed range.
        """
        values = settings.model_dump()
        for name in ("cloud_fwhm_mm", "diffusion_constant", "self_repulsion"):
            values[name] = values[name] if getattr(self, name) is None else getattr(self, name)
        for carrier in ("electron", "hole"):
            values[f"{carrier}_trapping_per_us"] += getattr(self, f"{carrier}_trapping_per_us")
            for at in ("low", "high"):
                name = f"{carrier}_velocity_{at}_factor"
                values[name] *= getattr(self, name)
        return checked(SimulationSettings, values, "settings, shifted")
