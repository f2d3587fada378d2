"""Studies with many runs: ensembles over seeds and searches over settings."""
