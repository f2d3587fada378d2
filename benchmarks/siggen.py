"""Compare drift and pulses with those of siggen, from the optional reference vectors.

Run with ``python benchmarks/siggen.py FOLDER``, the folder that holds ``siggen/``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cpunet.simulation.fields import FieldMaps, compute_fields
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulator import Simulator

PLAIN = SimulationSettings(dt_ns=1, length_ns=3600, diffusion=False, cloud_fwhm_mm=0)
CLOUD = PLAIN.model_copy(
    update={"diffusion": True, "diffusion_constant": "siggen", "cloud_fwhm_mm": 0.1}
)


def stored_maps(folder: Path) -> Any:
    """Every fifth node of the reference's 0.1 mm solution."""
    with np.load(folder / "maps_A_outertaper.npz") as maps:
        return SimpleNamespace(
            grid_mm=0.5,
            potential_V=maps["V_01"],
            e_r_V_per_cm=maps["Er_01"],
            e_z_V_per_cm=maps["Ez_01"],
            weighting_potential=maps["WP_01"],
            region=maps["point_type"],
        )


def compare(folder: Path, fields: FieldMaps) -> None:
    plain_drift, with_cloud = (
        Simulator(read_detector("icpc"), settings, fields=fields) for settings in (PLAIN, CLOUD)
    )
    with np.load(folder / "waveforms_plain_A_outertaper_grid0.1.npz") as plain:
        expected, (x, y, z) = plain["wf1"], plain["positions"].T
        found = plain_drift.signals(x, y, z, 100.0).waveforms
    worst = np.abs(found - expected).max(axis=1)
    rms = np.sqrt(np.mean((found - expected) ** 2, axis=1))
    late = np.subtract(*(np.argmax(w > 0.995, axis=1) for w in (found, expected)))
    print(f"  plain: worst sample {np.median(worst):.1e} (median of {len(worst)})", end="")
    print(f", within 1e-3: {(worst < 1e-3).sum()}; RMS {rms.max():.1e} at most", end="")
    print(f"; collected {np.median(late):+.0f} ns later (median), {np.abs(late).max()} at most")
    with np.load(folder / "waveforms_diffusion_A_outertaper_grid0.1.npz") as cloud:
        x, y, z = cloud["positions"].T
        signals = with_cloud.signals(x, y, z, 100.0)
        width = np.abs(signals.cloud_fwhm_ns / cloud["fwhm_steps"] - 1)
        rms = np.sqrt(np.mean((signals.waveforms - cloud["wf1"]) ** 2, axis=1))
    print(f"  cloud: width within 5 %: {(width < 0.05).sum()} of {len(width)}", end="")
    print(f", worst {width.max():.1%} (one step); RMS {rms.max():.1e} at most")
    with np.load(folder / "drift_paths_A_grid0.1.npz") as reference:
        _, paths = plain_drift.paths(*reference["positions"].T)
        theirs = reference["paths"][:, : PLAIN.n_samples]
        holes = np.nanmax(np.linalg.norm(paths - theirs[..., 3:], axis=2))
    print(f"  paths of holes within {holes:.3f} mm")


def main() -> None:
    folder = Path(sys.argv[1]) / "siggen"
    print("given its own fields, every 0.5 mm:")
    compare(folder, stored_maps(folder))
    for conventions in ("true", "false"):
        print(f"own fields at 0.1 mm, siggen_conventions {conventions}:")
        detector = read_detector("icpc", [f"siggen_conventions={conventions}"])
        compare(folder, compute_fields(detector))


if __name__ == "__main__":
    main()
