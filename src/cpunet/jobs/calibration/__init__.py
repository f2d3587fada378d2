"""Detector and electronics found together: a run, and the detector that goes with it."""
