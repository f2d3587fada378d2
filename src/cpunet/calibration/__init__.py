"""Joint calibration of the detector and its readout, for physics a chain cannot absorb.

The physics of a simulation is never exact, and a chain fitted to it absorbs part of the error.
But the chain is the same for all drift times, energies and topologies, while the effect of the
physics is not. Both are therefore fitted together to functions of the pulses in slices of
drift time, see docs/calibration.md.
"""
