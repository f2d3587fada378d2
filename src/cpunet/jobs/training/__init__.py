"""From two sets of pulses to a run: checks of the sets, networks and fitted responses."""
