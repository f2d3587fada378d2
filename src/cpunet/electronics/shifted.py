"""A detector that is not quite the one simulated, as a real one is."""

from __future__ import annotations

from importlib.resources import files

import yaml
from pydantic import ValidationError

from cpunet.errors import CpunetError
from cpunet.recipes.base import Config, NonNegative, Positive
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import SimulationSettings


class Shift(Config):
    """How a detector and its charge clouds differ from their simulation.

    Parameters
    ----------
    temperature_K
        Added to the crystal's.
    impurity_factor
        All impurities are scaled by it.
    cloud_fwhm_mm, self_repulsion
        Instead of the simulation's settings.
    """

    temperature_K: float
    impurity_factor: Positive
    cloud_fwhm_mm: NonNegative
    self_repulsion: bool

    @classmethod
    def default(cls) -> Shift:
        """The shift of the package."""
        text = (files("cpunet.electronics") / "shifted_detector.yaml").read_text()
        return cls.model_validate(yaml.safe_load(text))

    def detector(self, detector: Detector) -> Detector:
        """The detector as it is, of the detector as it is simulated.

        Raises
        ------
        CpunetError
            If there can be no such detector.
        """
        values = detector.model_dump()
        values["impurity_scale"] *= self.impurity_factor
        values["temperature_K"] += self.temperature_K
        try:
            return Detector.model_validate(values)
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            raise CpunetError(
                f"detector {detector.name}, shifted: {reason}; "
                "change temperature_K or the impurities"
            ) from error

    def settings(self, settings: SimulationSettings) -> SimulationSettings:
        """The settings of its pulses, of those of the simulation."""
        clouds = {"cloud_fwhm_mm": self.cloud_fwhm_mm, "self_repulsion": self.self_repulsion}
        return SimulationSettings.model_validate(settings.model_dump() | clouds)
