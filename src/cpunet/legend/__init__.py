"""What LEGEND's simulation chain reads: pulse-shape libraries and parameters."""
