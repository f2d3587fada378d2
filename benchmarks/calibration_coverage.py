"""Are the errors of a calibration right? Many small, disjoint experiments from large stands.

    cpunet stand --preset legend200 --events FEP=20000 --seed 11 --out big
    OMP_NUM_THREADS=1 python benchmarks/calibration_coverage.py big --sets 50

Prints the pulls, (found - true) / error, of each free parameter, with their mean and width;
``--figure FILE`` draws them.  The truth is read from the stand's ``stand.json``.

Events of a stand are independent, and each is used in one experiment only.  If the errors are
right, the mean pull of n experiments scatters by 1 / sqrt(n), for one stand or several.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from cpunet.calibration.nearby import Simulator
from cpunet.calibration.nuisances import Nuisance, Physics, named
from cpunet.calibration.search import Search
from cpunet.calibration.titles import titled
from cpunet.electronics.measured import measured_noise
from cpunet.plotting import styled
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry import Detector
from cpunet.simulation.stored_simulation import StoredSimulation
from cpunet.training.pulse_sets import PulseSets


@styled
def pulls_figure(pulls: dict[str, np.ndarray]) -> Figure:
    """Histograms of pulls beside the normal distribution."""
    figure = Figure(figsize=(3.4 * len(pulls), 2.8))
    grid, edges = np.linspace(-4, 4, 200), np.linspace(-4, 4, 17)
    for panel, (name, values) in zip(
        figure.subplots(1, len(pulls), squeeze=False)[0], pulls.items(), strict=True
    ):
        panel.hist(values, edges, color="#0072B2", label=f"{len(values)} experiments")
        normal = np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi)
        panel.plot(grid, len(values) * 0.5 * normal, color="black", label="normal")
        panel.set_xlabel(f"pull of {titled(name, units=False)}")
        panel.set_ylabel("experiments")
        panel.set_title(f"{values.mean():+.2f}, width {values.std(ddof=1):.2f}")
        panel.margins(y=0.35)  # room for the legend
    figure.axes[0].legend(loc="upper left", ncols=2)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stands", type=Path, nargs="+")
    parser.add_argument("--sets", type=int, default=50, help="parts of each stand")
    parser.add_argument("--first", type=int, help="only so many of them")
    parser.add_argument("--free", default="temperature,impurity")
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    nuisances = tuple(named(name) for name in arguments.free.split(","))
    found, begun = [], time.perf_counter()
    print("stand, part, chi-square, pulls of", ", ".join(n.name for n in nuisances))
    for stand in arguments.stands:
        for i, result in enumerate(experiments(stand, nuisances, arguments.sets)):
            found.append(result)
            told = "  ".join(f"{pull:+.2f}" for pull in result.pulls)
            print(f"{stand} {i + 1:3d}  {result.chi_square:.2f}  {told}", flush=True)
            if i + 1 == arguments.first:
                break
    pulls = np.array([result.pulls for result in found])
    errors = np.median([result.errors for result in found], axis=0)
    chi = np.array([result.chi_square for result in found])
    print(f"{len(found)} experiments, {time.perf_counter() - begun:.0f} s")
    print(f"chi-square per function {chi.mean():.2f}, from {chi.min():.2f} to {chi.max():.2f}")
    for nuisance, error, of in zip(nuisances, errors, pulls.T, strict=True):
        print(
            f"{nuisance.name}: error {error:.3g}, pulls: mean "
            f"{of.mean():+.2f} ± {of.std() / len(of) ** 0.5:.2f}, width {of.std(ddof=1):.2f}"
        )
    if arguments.figure:
        named_pulls = {n.name: pulls[:, j] for j, n in enumerate(nuisances)}
        pulls_figure(named_pulls).savefig(
            arguments.figure, dpi=110, metadata={"Software": None}
        )


class Experiment(NamedTuple):
    """Pulls and errors of the free coordinates, and chi-square per function."""

    pulls: np.ndarray
    errors: np.ndarray
    chi_square: float


def experiments(
    stand: Path, nuisances: tuple[Nuisance, ...], sets: int
) -> Iterator[Experiment]:
    """Calibrate disjoint parts of a stand."""
    recipe = load_recipe("fast")
    selection = parse_selection("FEP", recipe.peaks)
    files = [PulseFile(stand / f"{name}.lh5") for name in ("sim", "data")]
    sim = load_pulses(files[0], "simulated", recipe, selection).prepared
    measured = load_pulses(files[1], "measured", recipe, selection)
    data = measured.prepared
    noise, _ = measured_noise(measured, recipe.preparation)
    stored = StoredSimulation.read(files[0].path)
    physics = Physics(stored.detector, stored.settings, nuisances)
    truth = true_coordinates(physics, json.loads((stand / "stand.json").read_text())["data"])
    rng = np.random.default_rng(1)
    n = min(len(sim), len(data)) // sets
    rows = [rng.permutation(len(side))[: n * sets] for side in (sim, data)]
    for i in range(sets):
        some, measured = (
            side[order[i * n : (i + 1) * n]]
            for side, order in zip((sim, data), rows, strict=True)
        )
        calibrated = Search(
            simulator=Simulator(stored.hits[some.index], physics),
            sets=PulseSets(
                some.pulses, measured.pulses, noise, recipe, np.random.default_rng(i)
            ),
            energy_kev=some.pulses.energy_kev,
            recipe=recipe,
            free=list(range(len(nuisances))),
        ).run()
        yield Experiment(
            (calibrated.problem.parameters.coordinates - truth) / calibrated.errors,
            calibrated.errors,
            calibrated.chi_square / calibrated.problem.moments,
        )


def true_coordinates(physics: Physics, made: dict) -> np.ndarray:
    """Coordinates of the data side of a stand."""
    detector = Detector.model_validate(made["detector"])
    coordinates = []
    for nuisance in physics.nuisances:
        nominal = physics.nominal(nuisance)
        if nuisance.name == "impurity_factor":
            value = detector.impurity_scale / physics.detector.impurity_scale
        elif nuisance.field in made["detector"]:
            value = made["detector"][nuisance.field]
        else:
            value = made["settings"][nuisance.field]
        coordinates.append(nuisance.coordinate(nominal, float(value)))
    return np.array(coordinates)


if __name__ == "__main__":
    main()
