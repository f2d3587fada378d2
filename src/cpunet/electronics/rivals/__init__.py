"""What a user would pick instead of a network: each method fitted to the same unpaired sets."""
