"""Read files of pulses block by block; `open_pulses` detects the format."""

from cpunet.pulses.reading.files import open_pulses, table_sizes
from cpunet.pulses.reading.source import PulseSource

__all__ = ["PulseSource", "open_pulses", "table_sizes"]
