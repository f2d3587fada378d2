"""Are the errors of a calibration right? Many small, disjoint experiments from one large stand.

    cpunet stand --preset legend200 --events FEP=20000 --seed 11 --out big
    OMP_NUM_THREADS=1 python benchmarks/calibration_coverage.py big --sets 50

Prints mean and width of the pulls, (found - true) / error, of each free parameter, and with
``--figure FILE`` draws them.  The truth is that of the stand's ``stand.json``.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cpunet.analysis.style import styled
from cpunet.calibration.nearby import Simulator
from cpunet.calibration.nuisances import Physics, named
from cpunet.calibration.search import Search
from cpunet.jobs.common.inputs import InputFile, load_measured, load_simulated
from cpunet.jobs.common.measured_noise import measured_noise
from cpunet.jobs.common.monitor import Monitor
from cpunet.jobs.simulation.stored_simulation import StoredSimulation
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry import Detector
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
        panel.set_xlabel(f"pull of {name}")
        panel.set_title(f"{values.mean():+.2f}, width {values.std(ddof=1):.2f}")
    figure.axes[0].legend()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stand", type=Path)
    parser.add_argument("--sets", type=int, default=50)
    parser.add_argument("--free", default="temperature,impurity")
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    recipe, quiet = load_recipe("fast"), Monitor()
    selection = parse_selection("FEP", recipe.peaks)
    files = [InputFile(arguments.stand / f"{name}.lh5") for name in ("sim", "data")]
    sim = load_simulated(files[0], recipe, selection, quiet).prepared
    data = load_measured(files[1], recipe, selection, quiet).prepared
    noise, _ = measured_noise(files[1], data.pulses, recipe.preparation)
    stored = StoredSimulation.read(files[0].path)
    nuisances = tuple(named(name) for name in arguments.free.split(","))
    physics = Physics(stored.detector, stored.settings, nuisances)
    made = json.loads((arguments.stand / "stand.json").read_text())["data"]
    truth = true_coordinates(physics, made)
    rng = np.random.default_rng(1)
    n = min(len(sim), len(data)) // arguments.sets
    rows = [rng.permutation(len(side))[: n * arguments.sets] for side in (sim, data)]
    found, errors, chi, begun = [], [], [], time.perf_counter()
    for i in range(arguments.sets):
        some, measured = (
            side[order[i * n : (i + 1) * n]]
            for side, order in zip((sim, data), rows, strict=True)
        )
        sets = PulseSets(some.pulses, measured.pulses, noise, recipe, np.random.default_rng(i))
        calibrated = Search(
            simulator=Simulator(stored.hits[some.index], physics),
            sets=sets,
            energy_kev=some.pulses.energy_kev,
            recipe=recipe,
            free=list(range(len(nuisances))),
        ).run()
        found.append(calibrated.problem.parameters.coordinates)
        errors.append(calibrated.errors)
        chi.append(calibrated.chi_square / calibrated.problem.moments)
    pulls = (np.array(found) - truth) / np.array(errors)
    seconds = time.perf_counter() - begun
    print(f"{arguments.sets} experiments of {n} pulses a side, {seconds:.0f} s")
    print(f"chi-square per function {np.mean(chi):.2f}, from {min(chi):.2f} to {max(chi):.2f}")
    for j, nuisance in enumerate(nuisances):
        of = pulls[:, j]
        print(
            f"{nuisance.name}: error {np.median(np.array(errors)[:, j]):.3g}, pulls: mean "
            f"{of.mean():+.2f} ± {of.std() / len(of) ** 0.5:.2f}, width {of.std(ddof=1):.2f}"
        )
    if arguments.figure:
        named_pulls = {n.name: pulls[:, j] for j, n in enumerate(nuisances)}
        pulls_figure(named_pulls).savefig(
            arguments.figure, dpi=110, metadata={"Software": None}
        )


def true_coordinates(physics: Physics, made: dict) -> np.ndarray:
    """Where the data's side of a stand is."""
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
