"""Are the errors of a calibration right? Small test stands with physics from the priors.

    nice python benchmarks/calibration_coverage.py --stands 50 --results coverage.jsonl
    python benchmarks/calibration_coverage.py --stands 0 --figure pulls.png

Each stand has independent events of both sides, and the true values of a group of parameters,
the free ones of its fit, drawn from their priors.  If priors and errors are right, the pulls
(fitted - true) / error of every parameter have mean 0 and width 1, also where the prior knows
more than the pulses.  Each result is appended to the file at once; a stand whose result it
holds is not made again, so that the benchmark can be stopped, resumed and run in parts
(``--groups 1 2``).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import cpunet
from cpunet.calibration.nearby import Simulator
from cpunet.calibration.nuisances import Physics, named, titled
from cpunet.calibration.search import Search
from cpunet.electronics.measured import noise_of
from cpunet.plotting import styled
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.recipes import load_recipe
from cpunet.simulation.geometry_readers import read_detector
from cpunet.simulation.settings import SimulationSettings
from cpunet.simulation.simulate import StoredSimulation
from cpunet.training.pulse_sets import PulseSets

# All that may become free, in groups that are fitted together.
GROUPS = (
    ("temperature", "impurity", "self_repulsion"),
    ("diffusion", "cloud", "tilt"),
    ("hole_velocity_low", "hole_velocity_high"),
    ("electron_velocity_low", "electron_velocity_high"),
    ("hole_trapping", "electron_trapping"),
    ("bias", "li_thickness"),
)
# Simulated with values three errors of the prior or more from zero, which is a bound.
SIMULATED = {
    "self_repulsion": 1.0,
    "cloud_fwhm_mm": 0.6,
    "hole_trapping_per_us": 0.03,
    "electron_trapping_per_us": 0.03,
}
LINE_KEV = 2614.5
GIVEN = {"self_repulsion": (1.0, 0.33)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=Path("coverage.jsonl"))
    parser.add_argument("--stands", type=int, default=50, help="of each group")
    parser.add_argument("--groups", type=int, nargs="+", default=range(1, len(GROUPS) + 1))
    parser.add_argument("--events", type=int, default=500, help="full-energy ones of a stand")
    parser.add_argument("--simulated", type=int, default=1, help="times as many as measured")
    parser.add_argument("--detector", default="ppc")
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    results = _stored(arguments.results)
    done = {(one["group"], one["seed"]) for one in results}
    for seed in range(1, arguments.stands + 1):
        for group in arguments.groups:
            if (group, seed) in done:
                continue
            result = experiment(
                group, seed, arguments.detector, arguments.events, arguments.simulated
            )
            with arguments.results.open("a") as file:
                file.write(json.dumps(result) + "\n")
            results.append(result)
            pulls = "  ".join(f"{n} {_pull(v):+.2f}" for n, v in result["parameters"].items())
            about = f"{result['chi_square']:.2f}  {result['seconds']:3.0f} s"
            print(f"group {group}, stand {seed:2d}  {about}  {pulls}", flush=True)
    _print(results, arguments.figure)


def experiment(
    group: int, seed: int, detector: str, events: int, simulated: int
) -> dict[str, Any]:
    """Make a stand with physics drawn from the priors, and calibrate it.

    Of its measured pulses one in `simulated` is taken.
    """
    begun, names = time.perf_counter(), GROUPS[group - 1]
    nuisances = tuple(named(name) for name in names)
    rng = np.random.default_rng([group, seed])
    with tempfile.TemporaryDirectory() as folder:
        made = {k: v for k, v in SIMULATED.items() if k in {n.name for n in nuisances}}
        nominal = read_detector(detector)
        settings = SimulationSettings(**made)
        before = Physics(nominal, settings, nuisances, GIVEN)
        centres, widths = before.priors()
        drawn = centres + widths * rng.normal(size=len(widths))
        stand = cpunet.make_stand(
            Path(folder) / "stand",
            detector=detector,
            events={"FEP": events * simulated},
            shift=_shift(before, drawn),
            settings=[f"{name}={value}" for name, value in made.items()],
            seed=100 * group + seed,
        )
        search, truth = _search(stand, before, drawn, seed, simulated)
        problem, result = search.run()
    at, covariance = problem.coordinates, np.array(result.covariance)
    errors = np.sqrt(covariance.diagonal())
    return {
        "group": group,
        "seed": seed,
        "pulses": len(search.sets.sim),
        "chi_square": result.chi_square.after / problem.moments,
        "by_chance": problem.by_chance[0] / problem.moments,
        "rounds": result.rounds,
        "settled": result.settled,
        "seconds": time.perf_counter() - begun,
        "parameters": {
            n.name: {"found": float(x), "true": float(t), "error": float(e), "prior": float(w)}
            for n, x, t, e, w in zip(nuisances, at, truth, errors, widths, strict=True)
        },
        "covariance": result.covariance,
    }


def _shift(physics: Physics, coordinates: np.ndarray) -> dict[str, float]:
    """Shift of a stand to some coordinates."""
    shift = {}
    for nuisance, x in zip(physics.nuisances, coordinates, strict=True):
        nominal = physics.nominal(nuisance)
        value = nuisance.value(nominal, float(x))
        offset = nuisance.name in (
            "temperature_K", "bias_V", "li_thickness_mm", "impurity_tilt_1e10_per_cm4",
            "hole_trapping_per_us", "electron_trapping_per_us",
        )  # fmt: skip
        shift[nuisance.name] = value - nominal if offset else value
    return shift


def _search(
    stand: cpunet.Stand, before: Physics, drawn: np.ndarray, seed: int, simulated: int
) -> tuple[Search, np.ndarray]:
    recipe = load_recipe("fast").at(16)
    selection = parse_selection("2000-2700", recipe.peaks)
    sim = load_pulses(stand.sim, "simulated", recipe, selection).prepared
    measured = load_pulses(stand.data, "measured", recipe, selection)
    data = measured.prepared[::simulated]
    for side in (sim, data):  # the line is calibrated to its energy, whatever is trapped
        side.pulses.energy_kev[:] = LINE_KEV
    noise = noise_of(measured)
    stored = StoredSimulation.read(stand.sim.path)
    physics = Physics(stored.detector, stored.settings, before.nuisances, before.given)
    truth = [
        n.coordinate(physics.nominal(n), n.value(physics.nominal(n), float(x)))
        for n, x in zip(physics.nuisances, drawn, strict=True)
    ]
    search = Search(
        simulator=Simulator(stored.hits[sim.index], physics),
        sets=PulseSets(sim.pulses, data.pulses, noise, recipe, np.random.default_rng(seed)),
        chosen=True,
    )
    return search, np.array(truth)


def _stored(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


def _pull(one: dict[str, float]) -> float:
    return (one["found"] - one["true"]) / one["error"]


def _print(results: list[dict[str, Any]], figure: Path | None) -> None:
    """Print mean and width of the pulls of each parameter."""
    pulls: dict[str, list[float]] = {}
    known: dict[str, list[float]] = {}
    for one in results:
        for name, values in one["parameters"].items():
            pulls.setdefault(name, []).append(_pull(values))
            known.setdefault(name, []).append(values["error"] / values["prior"])
    for name, of in pulls.items():
        n = len(of)
        width = np.std(of, ddof=1) if n > 1 else float("nan")
        core = np.diff(np.quantile(of, [0.159, 0.841]))[0] / 2
        print(
            f"{name}: {n} stands, error {np.median(known[name]):.2f} of the prior, pulls: mean "
            f"{np.mean(of):+.2f} ± {1 / n**0.5:.2f}, width {width:.2f} ± "
            f"{(2 * n) ** -0.5:.2f}, core {core:.2f}"
        )
    if figure is not None:
        drawn = {name: np.array(of) for name, of in pulls.items()}
        pulls_figure(drawn).savefig(figure, dpi=110, metadata={"Software": None})


@styled
def pulls_figure(pulls: dict[str, np.ndarray]) -> Figure:
    """Histograms of pulls beside the normal distribution."""
    columns = min(4, len(pulls))
    rows = -(-len(pulls) // columns)
    figure = Figure(figsize=(3.0 * columns, 2.4 * rows))
    grid, edges = np.linspace(-4, 4, 200), np.linspace(-4, 4, 17)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[len(pulls) :]:
        panel.set_axis_off()
    for panel, (name, values) in zip(panels, pulls.items(), strict=False):
        panel.hist(values, edges, color="#0072B2")
        normal = np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi)
        panel.plot(grid, len(values) * 0.5 * normal, color="black")
        panel.set_xlabel(f"pull of {titled(name, units=False)}")
        panel.set_title(f"{len(values)}: {values.mean():+.2f}, width {values.std(ddof=1):.2f}")
    return figure


if __name__ == "__main__":
    main()
