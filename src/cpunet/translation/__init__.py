"""A trained run applied to pulses."""
