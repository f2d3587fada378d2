"""Common parts of all jobs: input files, devices, progress, memory, locks, noise, truth."""
