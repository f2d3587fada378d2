"""From energy deposits to charge pulses: hits, detector, fields, drift and signals."""
