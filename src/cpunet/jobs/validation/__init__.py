"""How well a run does: scores, baseline methods, figures, reports, comparisons."""
