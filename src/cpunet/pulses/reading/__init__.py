"""Any file of pulses, read block by block: `open_pulses` finds the format by itself."""

from cpunet.pulses.reading.opening import open_pulses, tables_of
from cpunet.pulses.reading.source import PulseSource

__all__ = ["PulseSource", "open_pulses", "tables_of"]
