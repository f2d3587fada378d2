"""Look at one thing: a file, a run's response, a detector's pulses by place."""
