"""Inspection of a file, of the response of a run, or of a detector's pulses by position."""
