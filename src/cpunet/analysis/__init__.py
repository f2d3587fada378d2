"""Pulse-shape parameters, comparison of distributions, paired scores, figures, report."""
