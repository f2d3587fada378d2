"""Validation of a run: scores, baseline methods, figures, reports, comparisons."""
