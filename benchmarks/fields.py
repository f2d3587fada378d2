"""Time for field maps of the detectors of the package: solved, and read from the cache.

Run with ``python benchmarks/fields.py``; takes about ten seconds.
"""

from __future__ import annotations

import os
import tempfile
import time

from cpunet.simulation.fields import compute_fields
from cpunet.simulation.geometry_readers import detector_names, read_detector


def main() -> None:
    for name in detector_names():
        detector = read_detector(name)
        seconds = []
        with tempfile.TemporaryDirectory() as folder:
            os.environ["CPUNET_CACHE"] = folder
            for _ in range(2):
                start = time.perf_counter()
                maps = compute_fields(detector)
                seconds.append(time.perf_counter() - start)
        shape = " x ".join(map(str, maps.potential_V.shape))
        print(
            f"{name}: {shape} nodes, solved {seconds[0]:.2f} s, cached {seconds[1]:.3f} s; "
            f"{maps.capacitance_pF:.3f} pF, depleted at {maps.depletion_V:.0f} V"
        )


if __name__ == "__main__":
    main()
