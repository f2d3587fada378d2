"""Deviations of learned readouts from the truth in units of their stated errors.

Run with ``python benchmarks/response_pulls.py STAND ...``; a stand is a folder of ``cpunet
stand``.
"""

from __future__ import annotations

import argparse

import numpy as np

import cpunet


def main() -> None:
    """Train on each stand, and print mean and width of each number's deviations."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stands", nargs="+")
    found: dict[str, list[float]] = {}
    for stand in parser.parse_args().stands:
        run = cpunet.train(f"{stand}/sim.lh5", f"{stand}/data.lh5")
        assert isinstance(run, cpunet.Run)
        for name, sigma in cpunet.response(run, truth=stand).sigma.items():
            found.setdefault(name, []).append(sigma)
    for name, values in found.items():
        width = np.sqrt(np.mean(np.square(values)))
        print(f"{name:<24}{len(values):3d} stands{np.mean(values):7.2f}{width:7.2f}")


if __name__ == "__main__":
    main()
