"""Simulate the library of pulse shapes that production simulations look up.

A library holds the charge pulse of every place in a detector.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cpunet.errors import CpunetError
from cpunet.legend.library_files import PERIOD_NS, put_array, put_column
from cpunet.outputs import refuse_existing
from cpunet.progress import stage
from cpunet.pulses.writing import written_hdf5
from cpunet.settings import Set
from cpunet.simulation.geometry import Detector
from cpunet.simulation.settings import detector_and_settings
from cpunet.simulation.simulator import Simulator

LENGTH_NS = 5000.0  # as in libraries of SolidStateDetectors.jl
ENERGY_KEV = 1000.0  # of each hit; matters only with self-repulsion
ANGLES_DEG = (0, 45)  # <100> and <110>; reboost interpolates between them


@dataclass
class MadeLibrary:
    """A library of charge pulses that was made.

    Parameters
    ----------
    path
        The file.
    templates
        Number of grid points times angles.
    written, outside, late
        Numbers of those with a template, without a signal, and whose charge is not collected
        within the record.
    """

    path: Path
    templates: int = 0
    written: int = 0
    outside: int = 0
    late: int = 0

    def __str__(self) -> str:
        return (
            f"{self.path}: {self.written} of {self.templates} places have a template; "
            f"{self.outside} give no signal, {self.late} are not collected in time"
        )


def make_library(
    detector: str | Path | Detector,
    out: str | Path,
    *,
    grid_mm: float = 1.0,
    settings: Set = (),
    force: bool = False,
) -> MadeLibrary:
    """Simulate the charge pulse of every place in a detector.

    The LH5 file holds ``struct{r, z, dt, t0, waveform_000_deg, drift_time_000_deg, ...}``
    under the detector's name: r and z in mm from the centre of the point contact, times in
    ns after the charge is created, pulses of unit charge as float32 arrays of shape
    (r, z, samples).  The drift times of the format are the collection times of all charge,
    `Signals.collection_time_ns`.  Grid points without a signal, and those whose charge is not
    collected within the record, are NaN.

    Parameters
    ----------
    detector
        icpc, bege, ppc, a YAML file, a siggen configuration or LEGEND metadata.
    out
        LH5 file to write.
    grid_mm
        Spacing of the places in r and z.
    settings
        Override a value of the detector or the simulation, bias_V=3500, or all those in a YAML
        file (repeatable); templates have length_ns=5000 without. Their period is 1 ns, as
        production reads them.
    force
        Replace an existing file.

    Returns
    -------
    MadeLibrary
        The file, with numbers of its templates.

    Raises
    ------
    CpunetError
        If the detector is not depleted, no grid point has a template, or the file cannot be
        written.

    Examples
    --------
    cpunet library make --detector icpc --out psl.lh5

    cpunet library make --detector icpc --out psl.lh5 --grid-mm 0.5 --set length_ns=3000
    """
    out = Path(out)
    words = () if isinstance(settings, Mapping) else settings
    inputs = [given for given in (detector, *words) if isinstance(given, str | Path)]
    refuse_existing(out, *inputs, force=force)
    detector, wanted = detector_and_settings(
        detector, settings, dt_ns=PERIOD_NS, length_ns=LENGTH_NS
    )
    if wanted.dt_ns != PERIOD_NS:
        raise CpunetError(
            f"settings: dt_ns = {wanted.dt_ns:g}: templates are sampled every nanosecond, as "
            "production reads them; leave dt_ns out"
        )
    if not (math.isfinite(grid_mm) and grid_mm > 0):
        raise CpunetError(f"`grid_mm` is {grid_mm}; expected more than 0")
    simulator = Simulator(detector, wanted)
    r_mm, z_mm = (
        np.arange(int(axis[-1] / grid_mm + 1e-6) + 1) * grid_mm
        for axis in (simulator.fields.r_mm, simulator.fields.z_mm)
    )
    counts = MadeLibrary(out)
    total = len(ANGLES_DEG) * len(r_mm) * len(z_mm)
    shape = (len(r_mm), len(z_mm))
    with written_hdf5(out) as (made, _), stage("Templates", total) as bar:
        library = made.create_group(detector.name or "detector")
        put_column(library, "r", r_mm, "mm")
        put_column(library, "z", z_mm, "mm")
        put_column(library, "dt", wanted.dt_ns, "ns")
        put_column(library, "t0", 0.0, "ns")
        for angle_deg in ANGLES_DEG:
            angle, whole = f"{angle_deg:03d}_deg", (*shape, wanted.n_samples)
            waveforms = put_array(library, f"waveform_{angle}", whole, np.float32, "")
            drift_times = put_array(library, f"drift_time_{angle}", shape, np.float64, "ns")
            phi = math.radians(angle_deg)
            for i, r in enumerate(r_mm):
                x, y = r * math.cos(phi), r * math.sin(phi)
                signals = simulator.signals(x, y, z_mm, ENERGY_KEV)
                good = signals.valid & signals.collected
                template = np.where(good[:, np.newaxis], signals.waveforms, np.float32(np.nan))
                waveforms[i] = template
                drift_times[i] = np.where(good, signals.collection_time_ns, np.nan)
                counts.templates += len(z_mm)
                counts.written += int(good.sum())
                counts.outside += int((~signals.valid).sum())
                counts.late += int((signals.valid & ~signals.collected).sum())
                bar.update(len(z_mm))
        library.attrs["datatype"] = f"struct{{{','.join(library)}}}"
        if not counts.written:
            raise CpunetError(f"{counts}; give a finer grid or longer records")
    return counts
