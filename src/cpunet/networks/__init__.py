"""The networks of CPU-Net: generators (REN, IREN) and discriminators."""
