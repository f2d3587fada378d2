"""Effect of the diffusion constant of the charge cloud on the maximum current.

Run with ``python benchmarks/diffusion.py``; takes about a minute.
"""

from __future__ import annotations

import numpy as np

from cpunet.simulation.fields import compute_fields
from cpunet.simulation.geometry_readers import detector_names, read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator

HITS = 2000
CONSTANTS = ("temperature", 0.12, "siggen")


def main() -> None:
    for name in detector_names():
        detector = read_detector(name)
        fields, rng = compute_fields(detector), np.random.default_rng(0)
        u = rng.random((3, 6 * HITS))
        r, z = detector.crystal_radius * np.sqrt(u[0]), detector.crystal_length * u[1]
        x, y = r * np.cos(2 * np.pi * u[2]), r * np.sin(2 * np.pi * u[2])
        x, y, z = np.stack([x, y, z])[:, detector.active(r, z)][:, :HITS]
        for dt in (1, 16):
            largest, duration = {}, {}
            for constant in CONSTANTS:
                settings = SimulationSettings(
                    dt_ns=dt, length_ns=4000, diffusion_constant=constant
                )
                pulses = Simulator(detector, settings, fields=fields).signals(x, y, z, 1592.0)
                rises = np.diff(pulses.waveforms[pulses.valid], prepend=0)
                largest[constant] = rises.max(axis=1)
                duration[constant] = np.median(pulses.cloud_fwhm_ns[pulses.valid])
            durations = ", ".join(f"{c} {duration[c]:.1f} ns" for c in CONSTANTS)
            print(f"{name}, samples of {dt} ns: median duration of the cloud: {durations}")
            for constant in CONSTANTS[::2]:
                change = largest[constant] / largest[0.12] - 1
                low, middle, high = np.quantile(change, [0.05, 0.5, 0.95])
                print(
                    f"  I_max with {constant} against 0.12: {middle:+.2%} "
                    f"(90 % from {low:+.2%} to {high:+.2%})"
                )


if __name__ == "__main__":
    main()
