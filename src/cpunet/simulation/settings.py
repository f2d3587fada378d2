"""Settings of the simulation: source, hits, steps, cloud; shifts of its physics."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from cpunet.settings import C, Config, Set, checked, key_values
from cpunet.simulation.geometry import Detector
from cpunet.simulation.geometry_readers import read_detector

_Factor = Annotated[float, Field(ge=0.2, le=5)]
_Nanoseconds = Annotated[float, Field(ge=0.01, le=1e6)]
_Diffusion = Annotated[float, Field(gt=0, le=1000)]
_PerUs = Annotated[float, Field(ge=0, le=100)]
# Steps to propose for a period that the step does not divide.
_FINER_NS = (2.0, 1.0, 0.5, 0.25, 0.1, 0.05, 0.01)

# Default of the distance within which hits are merged. Charge repels within a merged hit, so
# the distance must be that of a track: the 3.8 hits of 0.32 MeV of an event at 2.6 MeV repel
# like one of 1.24 MeV, the mean of hits merged within 0.2 mm. Within 0.05 mm tracks fall to
# crumbs, and a calibration finds 4 to 5 times siggen's repulsion (docs/calibration.md).
MERGING_MM = 0.2


class SimulationSettings(Config):
    r"""Settings of the pulse simulation.

    Parameters
    ----------
    step_ns
        Time step of the pulses and of the drift in ns.
    dt_ns
        Sampling period of the pulses in ns. Each sample is the mean over its time steps.
    length_ns
        Length of the record in ns. It starts when the charge is released.
    diffusion
        Whether the charge cloud grows by diffusion.
    diffusion_constant
        D/(v/E), the ratio of diffusivity to mobility, in V mm/cm. Siggen's 0.12 was set to the
        diffusion measured (for electrons: Jacoboni et al., PRB 24 (1981) 1014) at the fields
        of a detector, where carriers are hotter than the crystal. ``"temperature"`` is kT/e at
        the temperature of the crystal (0.078 at 90 K), the limit of weak fields.
        ``"siggen"`` is 0.12 with siggen's rounding of the number and of the cloud's duration
        to whole steps.
    cloud_fwhm_mm
        Initial FWHM of the charge cloud in mm.
    self_repulsion
        Strength of the self-repulsion of the cloud of each hit, as a factor of siggen's: 0 (or
        false) for none, 1 (or true) for all of it.
    electron_velocity_low_factor, electron_velocity_high_factor
        Factors of the electron speed below 250 V/cm and above 1000 V/cm. In between the
        factor varies smoothly with the logarithm of the field.
    hole_velocity_low_factor, hole_velocity_high_factor
        The same for holes.
    electron_trapping_per_us, hole_trapping_per_us
        Rate of permanent trapping, the inverse of the lifetime in us. A trapped charge induces
        no further signal, which lowers the collected energy.
    cluster_mm
        Hits nearer than this are merged; 0 merges none. Charge repels within what is merged.
    window_kev
        Half-width about a peak in which events are wanted; wider ones bring the continuum with
        them.
    source_height_mm, source_radius_mm
        Height above the crystal and radius of the source of gammas, a disc.
    """

    switches = ("self_repulsion",)

    step_ns: _Nanoseconds = 1.0
    dt_ns: _Nanoseconds = 16.0
    length_ns: Annotated[float, Field(gt=0, le=1e5)] = 3600.0
    diffusion: bool = True
    diffusion_constant: _Diffusion | Literal["temperature", "siggen"] = 0.12
    cloud_fwhm_mm: Annotated[float, Field(ge=0, le=20)] = 0.1
    self_repulsion: Annotated[float, Field(ge=0, le=100)] = 0.0
    electron_velocity_low_factor: _Factor = 1.0
    electron_velocity_high_factor: _Factor = 1.0
    hole_velocity_low_factor: _Factor = 1.0
    hole_velocity_high_factor: _Factor = 1.0
    electron_trapping_per_us: _PerUs = 0.0
    hole_trapping_per_us: _PerUs = 0.0
    cluster_mm: Annotated[float, Field(ge=0, le=100)] = MERGING_MM
    window_kev: Annotated[float, Field(gt=0, le=1e4)] = 0.5
    source_height_mm: Annotated[float, Field(gt=0, le=1e4)] = 20.0
    source_radius_mm: Annotated[float, Field(ge=0, le=1e4)] = 5.0

    @property
    def n_samples(self) -> int:
        """Samples per pulse."""
        return int(self.length_ns / self.dt_ns + 1e-9)

    @property
    def steps_per_sample(self) -> int:
        """Time steps per sample."""
        return round(self.dt_ns / self.step_ns)

    @field_validator("diffusion_constant", mode="before")
    @classmethod
    def _known_diffusion(cls, value: Any) -> Any:
        with suppress(TypeError, ValueError, OverflowError):
            if value in ("temperature", "siggen") or 0 < float(value) <= 1000:
                return value
        raise ValueError("give a number above 0 (to 1000) in V mm/cm, temperature or siggen")

    @model_validator(mode="after")
    def _whole_steps(self) -> SimulationSettings:
        steps = [self.step_ns, *(s for s in _FINER_NS if s < self.step_ns)]
        dividing = [s for s in steps if abs((n := self.dt_ns / s) - max(round(n), 1)) < 1e-9]
        if self.step_ns not in dividing:
            remedy = f"add step_ns={dividing[0]:g}" if dividing else "choose another"
            raise ValueError(
                f"dt_ns must be a multiple of step_ns, {self.step_ns:g} ns; {remedy}"
            )
        if self.length_ns < self.dt_ns:
            raise ValueError("length_ns must be at least dt_ns")
        return self


_SHIFTS = Path(__file__).parent / "shifts"

Factor = Annotated[float, Field(gt=0)]
# keys of `Shift` that stand for another field
_NAMES = {"impurity_factor": "impurity_scale", "li_thickness_mm": "li_thickness"}


def detector_and_settings(
    detector: str | Path | Detector, overrides: Set, **defaults: float
) -> tuple[Detector, SimulationSettings]:
    """Read a detector, and the settings of its simulation; `overrides` are values of both.

    Parameters
    ----------
    detector
        See `read_detector`.
    overrides
        Values by key, words as ``"bias_V=3500"``, or YAML files.
    defaults
        Settings of the simulation, unless overridden.

    Raises
    ------
    CpunetError
        If a file cannot be read, or a value is not allowed.

    Examples
    --------
    >>> words = ["bias_V=3500", "hole_trapping_per_us=0.01"]
    >>> detector, settings = detector_and_settings("icpc", words)
    >>> detector.bias_V, settings.hole_trapping_per_us
    (3500.0, 0.01)
    """
    values = key_values(overrides, files=True)
    own = {key: values.pop(key) for key in [*values] if key in SimulationSettings.model_fields}
    settings = checked(SimulationSettings, defaults | own, "settings")
    return read_detector(detector, values), settings


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
    >>> shift.applied(read_detector("icpc")).temperature_K
    91.5
    >>> shift.applied(SimulationSettings()).hole_velocity_low_factor
    0.95
    """

    switches = ("self_repulsion",)

    temperature_K: float = 0.0
    bias_V: float = 0.0
    impurity_factor: Factor = 1.0
    impurity_tilt_1e10_per_cm4: float = 0.0
    li_thickness_mm: float = 0.0
    electron_velocity_low_factor: Factor = 1.0
    electron_velocity_high_factor: Factor = 1.0
    hole_velocity_low_factor: Factor = 1.0
    hole_velocity_high_factor: Factor = 1.0
    electron_trapping_per_us: float = 0.0
    hole_trapping_per_us: float = 0.0
    cloud_fwhm_mm: float | None = None
    diffusion_constant: float | Literal["temperature", "siggen"] | None = None
    self_repulsion: float | None = None

    @classmethod
    def of(cls, parts: Set) -> Shift:
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
        return checked(cls, key_values(parts, files=True, folder=_SHIFTS), "shift")

    def applied(self, to: C) -> C:
        """Shifted version of a detector or of simulation settings.

        Raises
        ------
        CpunetError
            If a value is outside the allowed range.
        """
        values = to.model_dump()
        for key, change in self.model_dump(exclude_none=True).items():
            name = _NAMES.get(key, key)
            if name not in values:
                continue
            if type(self).model_fields[key].default is None:
                values[name] = change
            elif key.endswith("_factor"):
                values[name] *= change
            else:
                values[name] += change
        what = f"detector {to.name}" if isinstance(to, Detector) else "settings"
        return checked(type(to), values, f"{what}, shifted")
