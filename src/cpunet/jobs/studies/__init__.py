"""Many runs: ensembles over seeds and searches over settings, in several processes."""
