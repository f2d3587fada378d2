"""Public names and where they are: for type checkers, and for the package, which loads them."""

from cpunet.calibration.calibrate import calibrate as calibrate
from cpunet.calibration.calibrated_run import Calibration as Calibration
from cpunet.calibration.calibrated_run import Plan as Plan
from cpunet.demonstration import demo as demo
from cpunet.electronics.stand import Stand as Stand
from cpunet.electronics.stand import make_stand as make_stand
from cpunet.errors import CpunetError as CpunetError
from cpunet.inspection import info as info
from cpunet.inspection import load as load
from cpunet.legend.export import LegendParameters as LegendParameters
from cpunet.legend.export import export_legend as export_legend
from cpunet.legend.library_files import make_library as make_library
from cpunet.legend.translate_library import translate_library as translate_library
from cpunet.pulses.container import Pulses as Pulses
from cpunet.pulses.reading import open_pulses as open_pulses
from cpunet.pulses.reading.files import FileOptions as FileOptions
from cpunet.pulses.reading.files import PulseFile as PulseFile
from cpunet.pulses.reading.files import ReadOptions as ReadOptions
from cpunet.recipes import list_recipes as list_recipes
from cpunet.simulation.hits import HitOptions as HitOptions
from cpunet.simulation.simulate import HitFile as HitFile
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

__version__: str
__all__: list[str]
HOMES: dict[str, str]
DISTRIBUTION: str
OTHER: str

def other_package() -> str | None: ...
def __dir__() -> list[str]: ...
