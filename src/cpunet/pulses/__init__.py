"""Pulses from files, prepared, cut and written again."""
