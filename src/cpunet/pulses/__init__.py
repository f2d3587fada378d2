"""Read pulses from files, prepare them, apply quality cuts and write them."""
