"""Translate ideal pulse-shape libraries: time, memory, and A/E of events from the library.

    python benchmarks/simflow_library.py RUN [--detector icpc] [--grid-mm 0.5]
    python benchmarks/simflow_library.py RUN --detector geometry_A.yaml --hits g4_h20mm.npz

RUN contains a readout chain.  Each step runs in its own process, to measure its peak memory.
With ``--hits``, in the frame of the detector, A/E of events above 600 keV from the library and
reboost is compared with that of exactly drifted events translated as a whole: at the library's
own azimuth, and at that of the hits.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import awkward as ak
import h5py
import numpy as np
from reboost import units
from reboost.hpge import psd, utils

from cpunet.legend.currents import PEAK, currents_about_peak
from cpunet.legend.translate_library import TemplateTranslator
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.hit_files import read_hits
from cpunet.simulation.hits import Hits
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator, merge_hits
from cpunet.translation.translator import REN

SETTINGS = SimulationSettings(dt_ns=1.0, length_ns=5000.0)


def run(*words: object) -> None:
    """Run a command, and print its time and memory."""
    begun = time.monotonic()
    program = "from cpunet.cli import main; main()"
    process = subprocess.Popen([sys.executable, "-c", program, *map(str, words)])
    _, status, used = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"cpunet {words[0]} failed")
    print(
        f"  {' '.join(map(str, words[:2]))}: {time.monotonic() - begun:.0f} s, "
        f"{used.ru_utime + used.ru_stime:.0f} s of CPU, {used.ru_maxrss / 1000:.0f} MB",
        flush=True,
    )


def events_of(path: Path, detector: str) -> Hits:
    """Events above 600 keV: their hits merged, those in the lithium left out."""
    hits = read_hits(path)
    hits = merge_hits(hits[np.flatnonzero(hits.energy_kev > 600)], 0.05)
    active = read_detector(detector).active(hits.r_mm, hits.z_mm)
    ends = np.append(0, np.cumsum(active))[hits.offsets]
    hits = Hits.of(hits.position_mm[active], hits.edep_kev[active], ends, hits.event_number)
    return hits[np.flatnonzero(np.diff(hits.offsets) > 0)]


def drifted(folder: Path, detector: str, hits: Hits, mode: float) -> np.ndarray:
    """A/E of exactly drifted events, translated as a whole."""
    simulator, found = Simulator(read_detector(detector), SETTINGS), []
    translate = TemplateTranslator(REN.load(folder), 1.0)
    for first in range(0, len(hits), 500):
        waveforms = simulator.events(hits[first : first + 500]).waveforms
        found.append(currents_about_peak(translate(waveforms))[0][..., PEAK] / mode)
    return np.concatenate(found)


def read_out(path: Path, name: str, hits: Hits) -> np.ndarray:
    """A/E of events from the library, by reboost."""
    maps = utils.load_hpge_drift_time_maps(str(path), name, (0, 45))
    template = utils.load_hpge_pulse_shape_library(
        str(path), name, "waveform_000_deg", out_of_bounds_val=0
    )
    counts = np.diff(hits.offsets)
    x, y, z, kev = (
        units.attach_units(ak.unflatten(values, counts), unit)
        for values, unit in (
            (hits.x_mm, "mm"),
            (hits.y_mm, "mm"),
            (hits.z_mm, "mm"),
            (hits.edep_kev, "keV"),
        )
    )
    r = units.attach_units(ak.unflatten(np.hypot(hits.x_mm, hits.y_mm), counts), "mm")
    times = psd.drift_time_crystal_axes(x, y, z, maps)
    highest = psd.maximum_current(kev, times, r=r, z=z, template=template, times=None)
    return np.asarray(highest) / hits.energy_kev


def compare(folder: Path, detector: str, hits: Hits, path: Path) -> None:
    """Print how far A/E from the library is from the full translation."""
    with h5py.File(path) as file:
        ((name, library),) = file.items()
        mode = json.loads(library.attrs["cpunet"])["mode_per_ns"]
    radius = np.hypot(hits.x_mm, hits.y_mm)
    turned = replace(hits, position_mm=np.stack([radius, 0 * radius, hits.z_mm], axis=1))
    for title, these in (("azimuth 0", turned), ("own azimuth", hits)):
        full = drifted(folder, detector, these, mode)
        begun = time.monotonic()
        apart = 100 * (read_out(path, name, these) / full - 1)
        taken = time.monotonic() - begun
        quantiles = np.percentile(np.abs(apart), [50, 90, 99, 100])
        print(
            f"  {len(hits)} events, {title}: A/E apart by "
            + ", ".join(f"{q:.3f}" for q in quantiles)
            + f" % (50, 90, 99, 100 %); within 0.2 %: {100 * (np.abs(apart) < 0.2).mean():.2f}"
            f" %; reboost {taken:.0f} s",
            flush=True,
        )


def main() -> None:
    """Make, translate, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--detector", default="icpc")
    parser.add_argument("--grid-mm", type=float, default=0.5)
    parser.add_argument("--hits", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        ideal, whole = Path(folder) / "ideal.lh5", Path(folder) / "psl.lh5"
        run("library", "make", "--detector", given.detector, "--grid-mm", given.grid_mm,
            "--out", ideal)  # fmt: skip
        words = ["library", "translate", given.run, ideal]
        name = read_detector(given.detector).name
        words += ["--detector", name] if name else []
        run(*words, "--out", whole)
        for file in (ideal, whole):
            print(f"  {file.name}: {file.stat().st_size / 1e6:.1f} MB")
        if given.hits:
            compare(given.run, given.detector, events_of(given.hits, given.detector), whole)


if __name__ == "__main__":
    main()
