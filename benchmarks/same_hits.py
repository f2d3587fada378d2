"""Pulses of the same hits with changed physics: cost of the exact and quick modes, and errors.

Prints by how much each change shifts the mean logarithm of the maximum current and the mean
rise and 90 % times, after a Gaussian of 24 ns that represents the electronics.
"""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from cpunet.simulation.gammas import EnergyWindow
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import Shift, SimulationSettings
from cpunet.simulation.simulate import GammaSource
from cpunet.simulation.simulator import Simulator, merge_hits

EVENTS = 500
SHIFTS = (
    {"temperature_K": 1.0},
    {"impurity_factor": 1.01},
    {"impurity_tilt_1e10_per_cm4": 0.005},
    {"bias_V": 20.0},
    {"li_thickness_mm": 0.1},
    {"hole_velocity_low_factor": 1.03},
    {"hole_velocity_high_factor": 1.03},
    {"cloud_fwhm_mm": 0.3},
    {"diffusion_constant": 0.09},
    {"self_repulsion": 0.5},
    {"hole_trapping_per_us": 0.01},
)


def moments(waveforms: npt.NDArray[np.float32], dt_ns: float) -> npt.NDArray[np.float64]:
    """Mean log of the maximum current, mean rise time and mean 90 % time in ns."""
    smooth = gaussian_filter1d(waveforms.astype(float), 24 / dt_ns, axis=1)
    current = np.diff(smooth, axis=1).max(axis=1)
    t10, t90 = (_crossing(smooth, level) * dt_ns for level in (0.1, 0.9))
    return np.array([np.log(current).mean(), (t90 - t10).mean(), t90.mean()])


def _crossing(smooth: npt.NDArray[np.float64], level: float) -> npt.NDArray[np.float64]:
    before, n = (smooth < level).sum(axis=1) - 1, np.arange(len(smooth))
    low, high = smooth[n, before], smooth[n, before + 1]
    return np.asarray(before + (level - low) / (high - low))


def main() -> None:
    detector = read_detector("icpc")
    settings = SimulationSettings(dt_ns=4, length_ns=2400)
    source = GammaSource({EnergyWindow("FEP", 2614.0, 2615.0): EVENTS}, 20.0, 5.0, 1)
    hits = merge_hits(Hits.concatenate(list(source.open(detector).blocks)), 0.05, detector)
    first = {}
    # the same events everywhere: those that lose less than 1 keV in the lithium layer
    kept = Simulator(detector, settings).events(hits).lost_kev < 1
    for mode in ("exact", "quick"):
        events = Simulator(detector, settings, quick=mode == "quick").events(hits)
        first[mode] = moments(events.waveforms[kept], 4)
        start = time.process_time()
        Simulator(detector, SimulationSettings(), quick=mode == "quick").events(hits)
        spent = time.process_time() - start
        print(f"{mode}: {spent:.2f} s of CPU for {EVENTS} events at 16 ns")
    print("shift: exact change of ln I_max, rise and 90 % time; error of the quick one")
    for values in SHIFTS:
        shift = Shift(**values)
        change = []
        for mode in ("exact", "quick"):
            other = shift.applied(detector), shift.applied(settings)
            events = Simulator(*other, quick=mode == "quick").events(hits)
            change.append(moments(events.waveforms[kept], 4) - first[mode])
        exact, error = change[0], change[1] / change[0] - 1
        changes = ", ".join(
            f"{e:+.2e} ({100 * d:+.1f} %)" for e, d in zip(exact, error, strict=True)
        )
        print(f"{next(iter(values))} {next(iter(values.values())):g}: {changes}")


if __name__ == "__main__":
    main()
