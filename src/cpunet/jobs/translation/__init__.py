"""From a run and a file to translated pulses, libraries and exported models."""
