"""Comparison of distributions, paired scores, A/E survival, figures and the report."""
