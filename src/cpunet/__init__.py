"""cpunet: make simulated germanium-detector pulses look measured.

Data flow in one direction through its subpackages: ``pulses`` → ``simulation`` →
``electronics`` → ``networks`` → ``training`` → ``calibration`` → ``translation`` →
``validation`` → ``legend`` → ``cli``.  See ``docs/design.md``.
"""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

from cpunet.installation import other_package

__version__ = "0.1.0"
__all__ = [
    "IREN",
    "REN",
    "Adc",
    "Calibration",
    "Comparison",
    "CpunetError",
    "FileOptions",
    "HitFile",
    "HitOptions",
    "LegendParameters",
    "LithiumLayer",
    "Plan",
    "PulseFile",
    "Pulses",
    "ReadOptions",
    "Report",
    "Run",
    "Simulation",
    "Stand",
    "Translation",
    "__version__",
    "calibrate",
    "check",
    "compare",
    "demo",
    "expand_library",
    "export_legend",
    "export_onnx",
    "import_weights",
    "info",
    "list_recipes",
    "lithium_table",
    "load",
    "make_library",
    "make_stand",
    "merge_libraries",
    "open_pulses",
    "read_library",
    "response",
    "simulate",
    "subtract_tails",
    "train",
    "translate",
    "translate_library",
    "tune",
    "validate",
]

if TYPE_CHECKING:
    from cpunet.calibration.calibrate import calibrate
    from cpunet.calibration.calibrated_run import Calibration, Plan
    from cpunet.demonstration import demo
    from cpunet.electronics.measured import subtract_tails
    from cpunet.electronics.stand import Stand, make_stand
    from cpunet.errors import CpunetError
    from cpunet.inspection import info, load
    from cpunet.legend.current_library import expand_library, merge_libraries, read_library
    from cpunet.legend.export import LegendParameters, export_legend
    from cpunet.legend.lithium import LithiumLayer, lithium_table
    from cpunet.legend.make_library import make_library
    from cpunet.legend.translate_library import translate_library
    from cpunet.pulses.container import Pulses
    from cpunet.pulses.reading import open_pulses
    from cpunet.pulses.reading.files import FileOptions, PulseFile, ReadOptions
    from cpunet.recipes import list_recipes
    from cpunet.simulation.hit_sources import HitFile
    from cpunet.simulation.hits import HitOptions
    from cpunet.simulation.simulate import Simulation, simulate
    from cpunet.training.check import check
    from cpunet.training.published import import_weights
    from cpunet.training.response import response
    from cpunet.training.run import Run
    from cpunet.training.train import train
    from cpunet.translation.export import export_onnx
    from cpunet.translation.options import Adc
    from cpunet.translation.translate import translate
    from cpunet.translation.translation import Translation
    from cpunet.translation.translator import IREN, REN
    from cpunet.validation.compare import Comparison, compare
    from cpunet.validation.report import Report
    from cpunet.validation.tune import tune
    from cpunet.validation.validate import validate

# torch takes seconds to import: `import cpunet` and `cpunet --help` must not wait for it
_HOMES = {
    "calibration.calibrate": ("calibrate",),
    "calibration.calibrated_run": ("Calibration", "Plan"),
    "demonstration": ("demo",),
    "electronics.measured": ("subtract_tails",),
    "electronics.stand": ("Stand", "make_stand"),
    "errors": ("CpunetError",),
    "inspection": ("info", "load"),
    "simulation.hit_sources": ("HitFile",),
    "legend.export": (
        "LegendParameters",
        "export_legend",
    ),
    "legend.lithium": (
        "LithiumLayer",
        "lithium_table",
    ),
    "legend.make_library": ("make_library",),
    "legend.current_library": (
        "expand_library",
        "merge_libraries",
        "read_library",
    ),
    "legend.translate_library": ("translate_library",),
    "translation.export": ("export_onnx",),
    "pulses.reading.files": ("FileOptions", "PulseFile", "ReadOptions"),
    "pulses.container": ("Pulses",),
    "pulses.reading": ("open_pulses",),
    "recipes": ("list_recipes",),
    "simulation.hits": ("HitOptions",),
    "training.check": ("check",),
    "training.published": ("import_weights",),
    "simulation.simulate": ("Simulation", "simulate"),
    "training.response": ("response",),
    "training.run": ("Run",),
    "training.train": ("train",),
    "translation.options": ("Adc",),
    "translation.translate": ("translate",),
    "translation.translation": ("Translation",),
    "translation.translator": ("IREN", "REN"),
    "validation.compare": ("Comparison", "compare"),
    "validation.report": ("Report",),
    "validation.tune": ("tune",),
    "validation.validate": ("validate",),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            if clash := other_package():
                warnings.warn(clash, stacklevel=2)
            return getattr(import_module(f"cpunet.{home}"), name)
    raise AttributeError(f"module 'cpunet' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
