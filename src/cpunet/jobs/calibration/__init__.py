"""Joint calibration of detector and electronics; its result is a run and a detector."""
