"""A detector that deviates from its simulation, as a real one does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError

from cpunet.errors import CpunetError
from cpunet.recipes.base import Config
from cpunet.regular_files import read_text
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.yaml_files import MAX_BYTES, key_and_value, shown, yaml_fields

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
    def default(cls) -> Shift:
        """Default shift of the package."""
        text = (files("cpunet.simulation") / "shifted_detector.yaml").read_text(
            encoding="utf-8"
        )
        return cls.model_validate(yaml.safe_load(text))

    @classmethod
    def of(cls, parts: Iterable[str]) -> Shift:
        """Combine YAML files and ``"KEY=VALUE"`` strings. Later ones take precedence.

        Raises
        ------
        CpunetError
            If a file cannot be read, or a key or value is not allowed.

        Examples
        --------
        >>> Shift.of(["temperature_K=2", "self_repulsion=0.5"]).self_repulsion
        0.5
        """
        values: dict[str, Any] = {}
        for part in parts:
            pair = key_and_value(part, "shift")
            values |= _file_values(Path(part)) if pair is None else [pair]
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise CpunetError(f"shift: {_problem(error, cls)}") from error

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
        try:
            return Detector.model_validate(values)
        except ValidationError as error:
            raise CpunetError(
                f"detector {detector.name}, shifted: {_problem(error, Detector)}; "
                "change the shift"
            ) from error

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
        try:
            return SimulationSettings.model_validate(values)
        except ValidationError as error:
            raise CpunetError(
                f"settings, shifted: {_problem(error, SimulationSettings)}; change the shift"
            ) from error


def _file_values(path: Path) -> Mapping[str, Any]:
    try:
        text = read_text(path, MAX_BYTES)
    except OSError as error:
        raise CpunetError(
            f"shift {path}: cannot be read; give KEY=VALUE or a YAML file"
        ) from error
    return yaml_fields(
        text,
        f"shift {path}",
        invalid="not YAML",
        empty="holds no shift; write lines such as temperature_K: 2",
    )


def _problem(error: ValidationError, kind: type[Config]) -> str:
    """First problem in one line that names the key."""
    first = error.errors()[0]
    # for a union the location includes its member
    key = str(first["loc"][0]) if first["loc"] else ""
    if first["type"] == "extra_forbidden":
        return f"no such key {key}; there are {', '.join(kind.model_fields)}"
    message = first["msg"].removeprefix("Value error, ")
    return f"{key} = {shown(first['input'])}: {message}" if key else message
