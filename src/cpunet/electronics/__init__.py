"""The detector readout: from ideal charge pulses to raw traces with a known truth."""
