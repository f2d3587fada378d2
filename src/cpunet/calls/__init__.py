"""Python functions for the main commands; they return arrays, histograms and figures.

Use them as `cpunet.train`, `cpunet.translate`, `cpunet.validate` and `cpunet.calibrate`.
"""
