"""From two prepared sets to trained networks in a run folder."""
