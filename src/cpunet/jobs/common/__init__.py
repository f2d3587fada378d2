"""What every job uses: input files, devices, progress, memory, locks, noise and truth."""
