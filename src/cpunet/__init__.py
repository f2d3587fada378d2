"""cpunet: make simulated germanium-detector pulses look measured.

Data flow in one direction through its subpackages: ``pulses`` → ``simulation`` →
``electronics`` → ``networks`` → ``training`` → ``calibration`` → ``translation`` →
``validation`` → ``legend`` → ``cli``.  See ``docs/design.md``.

The authors of CPU-Net publish their own code as ``cpunet``; this package's distribution is
called ``cpunet-hpge`` and is also imported as ``cpunet``.  Both install into the same folder,
so an environment can contain only one of them.
"""

from __future__ import annotations

import warnings
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
DISTRIBUTION, OTHER = "cpunet-hpge", "cpunet"

if TYPE_CHECKING:
    from cpunet.calibration.calibrate import calibrate as calibrate
    from cpunet.calibration.calibrated_run import Calibration as Calibration
    from cpunet.calibration.calibrated_run import Plan as Plan
    from cpunet.demonstration import demo as demo
    from cpunet.electronics.measured import subtract_tails as subtract_tails
    from cpunet.electronics.stand import Stand as Stand
    from cpunet.electronics.stand import make_stand as make_stand
    from cpunet.errors import CpunetError as CpunetError
    from cpunet.inspection import info as info
    from cpunet.inspection import load as load
    from cpunet.legend.current_library import expand_library as expand_library
    from cpunet.legend.current_library import merge_libraries as merge_libraries
    from cpunet.legend.current_library import read_library as read_library
    from cpunet.legend.export import LegendParameters as LegendParameters
    from cpunet.legend.export import export_legend as export_legend
    from cpunet.legend.lithium import LithiumLayer as LithiumLayer
    from cpunet.legend.lithium import lithium_table as lithium_table
    from cpunet.legend.make_library import make_library as make_library
    from cpunet.legend.translate_library import translate_library as translate_library
    from cpunet.pulses.container import Pulses as Pulses
    from cpunet.pulses.reading import open_pulses as open_pulses
    from cpunet.pulses.reading.files import FileOptions as FileOptions
    from cpunet.pulses.reading.files import PulseFile as PulseFile
    from cpunet.pulses.reading.files import ReadOptions as ReadOptions
    from cpunet.recipes import list_recipes as list_recipes
    from cpunet.simulation.hit_sources import HitFile as HitFile
    from cpunet.simulation.hits import HitOptions as HitOptions
    from cpunet.simulation.simulate import Simulation as Simulation
    from cpunet.simulation.simulate import simulate as simulate
    from cpunet.training.check import check as check
    from cpunet.training.published import import_weights as import_weights
    from cpunet.training.response import response as response
    from cpunet.training.run import Run as Run
    from cpunet.training.train import train as train
    from cpunet.translation.export import export_onnx as export_onnx
    from cpunet.translation.options import Adc as Adc
    from cpunet.translation.translate import translate as translate
    from cpunet.translation.translation import Translation as Translation
    from cpunet.translation.translator import IREN as IREN
    from cpunet.translation.translator import REN as REN
    from cpunet.validation.compare import Comparison as Comparison
    from cpunet.validation.compare import compare as compare
    from cpunet.validation.report import Report as Report
    from cpunet.validation.tune import tune as tune
    from cpunet.validation.validate import validate as validate

# torch takes seconds to import: `import cpunet` and `cpunet --help` must not wait for it
_HOMES = {
    "calibration.calibrate": ("calibrate",),
    "calibration.calibrated_run": ("Calibration", "Plan"),
    "demonstration": ("demo",),
    "electronics.measured": ("subtract_tails",),
    "electronics.stand": ("Stand", "make_stand"),
    "errors": ("CpunetError",),
    "inspection": ("info", "load"),
    "legend.current_library": ("expand_library", "merge_libraries", "read_library"),
    "legend.export": ("LegendParameters", "export_legend"),
    "legend.lithium": ("LithiumLayer", "lithium_table"),
    "legend.make_library": ("make_library",),
    "legend.translate_library": ("translate_library",),
    "pulses.container": ("Pulses",),
    "pulses.reading": ("open_pulses",),
    "pulses.reading.files": ("FileOptions", "PulseFile", "ReadOptions"),
    "recipes": ("list_recipes",),
    "simulation.hit_sources": ("HitFile",),
    "simulation.hits": ("HitOptions",),
    "simulation.simulate": ("Simulation", "simulate"),
    "training.check": ("check",),
    "training.published": ("import_weights",),
    "training.response": ("response",),
    "training.run": ("Run",),
    "training.train": ("train",),
    "translation.export": ("export_onnx",),
    "translation.options": ("Adc",),
    "translation.translate": ("translate",),
    "translation.translation": ("Translation",),
    "translation.translator": ("IREN", "REN"),
    "validation.compare": ("Comparison", "compare"),
    "validation.report": ("Report",),
    "validation.tune": ("tune",),
    "validation.validate": ("validate",),
}
__all__ = sorted(["__version__", *(name for names in _HOMES.values() for name in names)])


@cache
def other_package() -> str | None:
    """One-line message with a remedy if the other package is installed over this one.

    Returns
    -------
    str or None
        None if it is not installed, or in another folder.
    """
    here = Path(__file__).resolve().parent
    found = next(here.parent.glob(f"{OTHER}-*.dist-info"), None)
    if found is None:
        return None
    # Imported only here, since it would make `cpunet --help` wait for tens of milliseconds
    from importlib.metadata import Distribution

    other = Distribution.at(found)
    files = (Path(str(other.locate_file(file))) for file in other.files or ())
    if not any(here == file.parent.resolve() for file in files if file.suffix == ".py"):
        return None
    return (
        f"the package {OTHER} {other.version} is installed over {DISTRIBUTION}, of the same "
        f"import name; pip uninstall {OTHER} {DISTRIBUTION}, then install the one you want"
    )


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            if clash := other_package():
                warnings.warn(clash, stacklevel=2)
            return getattr(import_module(f"cpunet.{home}"), name)
    raise AttributeError(f"module 'cpunet' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
