"""The detector and its readout, calibrated together: physics that a chain cannot stand in for.

A simulation's physics are never quite right, and a chain that is fitted to it absorbs what it
can of that.  But the chain is the same for all drift times, energies and topologies; physics
are not.  So both are fitted at once to functions of the pulses in slices of drift time, see
docs/calibration.md.
"""
