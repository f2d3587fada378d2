"""From hits to ideal pulses: simulations, fields, virtual test stands and libraries."""
