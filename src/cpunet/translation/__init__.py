"""Apply a trained run to pulses."""
