"""Baseline methods a user would choose instead of a network, fitted to the same datasets."""
