"""The readout of a detector: from ideal charge pulses to raw traces with a known answer."""
