"""One call in Python for each command, with objects to look at: arrays, histograms, figures.

Use them as `cpunet.train`, `cpunet.translate`, `cpunet.validate` and `cpunet.calibrate`.
"""
