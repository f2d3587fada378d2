"""Joint calibration of detector and electronics, which gives a run and its detector."""
