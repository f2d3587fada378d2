"""Repulsion of the charge of real tracks: point charges against one cloud per merged hit.

Run with ``python benchmarks/repulsion.py HITS.npz``, with the hits of Geant4: ``hit_event``,
``pid``, ``tid``, ``x_mm``, ``dx_mm``, ..., ``edep_keV``.  A minute of processor time.

Tracks of electrons drift in a uniform field.  Each is divided into point charges that diffuse
and repel each other by Coulomb's law, as SolidStateDetectors.jl has them, or into hits whose
clouds grow by siggen's law, with the charge of the merged hit or of all hits within 1 mm.  A is
the maximum current after electronics with a Gaussian of 30 ns.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cpunet.kernels import kernel
from cpunet.simulation.drift import FWHM_PER_SIGMA, cloud_after_step
from cpunet.simulation.drift_maps import HOLE, carrier_velocity, velocity_table
from cpunet.simulation.hits import Hits
from cpunet.simulation.simulator import REPULSION_PER_KEV, merge_hits

Values = npt.NDArray[np.float64]
ENERGIES_KEV = (100, 200, 400, 700, 1000, 1400, 2000)
FIELD, DRIFT_NS, STEP_NS, BODIES, CLOUD_MM = 800.0, 600.0, 2.0, 300, 0.1
# Strengths relative to siggen's, between which its effect is interpolated.
STRENGTHS = (0.0, 0.15, 0.3, 0.6, 1.0)
# Field of 1 keV at 1 mm in V/cm: e / (4 pi eps) per 3 eV.
COULOMB = 9e13 / 16 / 0.003 / 6.241e18
TABLE = velocity_table(90.0)


def speed(field: float) -> float:
    return float(carrier_velocity(*TABLE, HOLE, field, 0.0, 0.0)[0])


SPEED = speed(FIELD)
MOBILITY, SLOPE = SPEED / FIELD, (speed(FIELD + 20) - speed(FIELD - 20)) / 40
DIFFUSION = 0.12 * MOBILITY  # mm2/ns


@kernel
def drifted(places: Values, each: float, rng: np.random.Generator) -> Values:
    """Places of equal charges of `each` V mm2/cm after the drift."""
    n, spread = len(places), np.sqrt(2 * DIFFUSION * STEP_NS)
    for _ in range(int(DRIFT_NS / STEP_NS)):
        field = np.zeros((n, 3))
        for i in range(n):
            for j in range(i):
                square = 0.0
                for axis in range(3):
                    square += (places[i, axis] - places[j, axis]) ** 2
                per_mm = each / max(square, 1e-4) ** 1.5
                for axis in range(3):
                    push = per_mm * (places[i, axis] - places[j, axis])
                    field[i, axis] += push
                    field[j, axis] -= push
        for i in range(n):
            for axis in range(3):
                per_field = SLOPE if axis == 2 else MOBILITY
                places[i, axis] += per_field * field[i, axis] * STEP_NS
                places[i, axis] += spread * rng.standard_normal()
    return places


def log_amplitude(z: Values, weights: Values, size: Values | float) -> float:
    """Logarithm of the maximum current of clouds that arrive one after the other."""
    width = np.sqrt(size**2 + (30 * SPEED) ** 2) * np.ones(len(z))
    at = np.average(z, weights=weights) + np.linspace(-1.5, 1.5, 121)
    current = (weights / width * np.exp(-0.5 * ((at[:, None] - z) / width) ** 2)).sum(axis=1)
    return float(np.log(current.max() / weights.sum()))


@kernel
def sigma(repulsion: Values) -> Values:
    """Widths (mm) of clouds that grow by siggen's law, for their repulsion constants."""
    found, diffusion = np.empty(len(repulsion)), DIFFUSION / MOBILITY * FWHM_PER_SIGMA**2
    for i in range(len(repulsion)):
        size = CLOUD_MM
        for step in range(int(DRIFT_NS / STEP_NS)):
            size = cloud_after_step(
                size, SPEED, SPEED, FIELD, SLOPE, diffusion, repulsion[i], STEP_NS, step
            )
        found[i] = size / FWHM_PER_SIGMA
    return found


def of_hits(places: Values, energy: Values, merging: float, near: float = 0.0) -> list[float]:
    """ln A by strength, of hits that repel with the energy within `near` mm, or their own."""
    hits = merge_hits(Hits.of(places, energy, [0, len(energy)]), merging)
    distance = np.linalg.norm(hits.position_mm[:, None] - hits.position_mm, axis=2)
    charge = (hits.edep_kev * (distance <= near)).sum(axis=1)
    widths = [sigma(strength * REPULSION_PER_KEV * charge) for strength in STRENGTHS]
    return [log_amplitude(hits.z_mm, hits.edep_kev, width) for width in widths]


MODELS: dict[str, tuple[float, ...]] = {
    "own charge, merged within 0.05 mm": (0.05,),
    "own charge, merged within 0.2 mm": (0.2,),
    "own charge, merged within 1 mm": (1.0,),
    "charge within 1 mm": (0.05, 1.0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("hits", type=Path)
    parser.add_argument("--tracks", type=int, default=6, help="of each energy")
    arguments = parser.parse_args()
    stored, rng = np.load(arguments.hits), np.random.default_rng(0)
    chosen = stored["pid"] == 11
    places, steps = (
        np.stack([stored[f"{name}_mm"][chosen] for name in names], axis=1)
        for names in (("x", "y", "z"), ("dx", "dy", "dz"))
    )
    energy = stored["edep_keV"][chosen]
    number = stored["hit_event"][chosen].astype(np.int64) * 10**6 + stored["tid"][chosen]
    _, track = np.unique(number, return_inverse=True)
    order = np.argsort(track, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(track[order])) + 1)
    total = np.bincount(track, energy)
    energies, bodies, clouds = [], [], []
    for wanted in ENERGIES_KEV:
        for t in np.flatnonzero(np.abs(total - wanted) < 0.07 * wanted)[: arguments.tracks]:
            rows, share = parts[t], energy[parts[t]] / total[t]
            some = rng.choice(rows, BODIES, p=share)
            start = places[some] + steps[some] * rng.uniform(-0.5, 0.5, (BODIES, 1))
            start += rng.normal(0, CLOUD_MM / FWHM_PER_SIGMA, (BODIES, 3))
            equal = np.ones(BODIES)
            bodies.append(
                [
                    log_amplitude(
                        drifted(start.copy(), each, np.random.default_rng(t))[:, 2], equal, 0.0
                    )
                    for each in (0.0, COULOMB * total[t] / BODIES)
                ]
            )
            clouds.append(
                [of_hits(places[rows], energy[rows], *how) for how in MODELS.values()]
            )
            energies.append(total[t] / 1000)
    mev, points, models = np.array(energies), 100 * np.array(bodies), 100 * np.array(clouds)

    def per_mev(values: Values) -> float:
        return float(np.polyfit(mev, values, 1)[0])

    effect = points[:, 1] - points[:, 0]
    print(f"{len(mev)} tracks; point charges: ln A {per_mev(points[:, 1]):+.3f} % per MeV, ")
    print(f"of which by repulsion {per_mev(effect):+.3f}; {effect.mean():+.3f} % on average")
    for name, found in zip(MODELS, np.moveaxis(models, 1, 0), strict=True):
        of_model = found - found[:, :1]
        strength = np.interp(-effect.mean(), -of_model.mean(axis=0), STRENGTHS)
        same = np.array([np.interp(strength, STRENGTHS, row) for row in of_model])
        print(
            f"{name}: ln A {per_mev(found[:, -1]):+.3f} % per MeV with siggen's strength; that "
            f"of the points is {strength:.2f} of it, with {per_mev(same - effect):+.3f} % per "
            f"MeV and {np.std(same - effect):.3f} % left"
        )


if __name__ == "__main__":
    main()
