"""The detector readout: from ideal charge pulses to raw traces with their truth."""
