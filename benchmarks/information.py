"""How well pulses determine the current amplitude, and how much of this the fit uses.

Run with ``python benchmarks/information.py STAND --pulses 3300``; STAND has many full-energy
pulses on both sides, and the truth.  It is split into sets of that many pulses.  Each is fitted
by the moments alone and with optimal weights, and the shift of the translated current amplitude
of the double-escape peak from the truth is printed for both.  A bound is printed beside them,
from the Fisher information of the best function of a pulse that a small network finds (Charnock
et al., Phys. Rev. D 97 (2018) 083004), on pulses that it has not seen.

``python benchmarks/information.py STAND --run RUN`` prints only the shift of a run.  With
``--chain RUN`` the data are simulated experiments: half of the stand's simulated pulses, with
the response of a run and noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numba
import numpy as np
import torch

from cpunet.electronics.finishing import finish
from cpunet.electronics.measured import noise_of
from cpunet.networks.response_layer import ElectronicsResponse, record_length
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.parameters import current_amplitude
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.preparation import prepare
from cpunet.pulses.reading.files import PulseFile, open_pulses
from cpunet.recipes import load_recipe
from cpunet.training import response_fit
from cpunet.training.fitter import Fitter
from cpunet.training.job import known_response
from cpunet.training.levenberg_marquardt import levenberg_marquardt
from cpunet.training.moments import Moments, Readings
from cpunet.training.optimal_weights import refine
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_problem import Band, Parameters, ResponseProblem
from cpunet.training.run import Run
from cpunet.training.translated import Noise, SimulatedSide
from cpunet.translation.translator import REN

RECIPE = load_recipe("fast").at(16)
CONFIG, TRAINING = RECIPE.matching


def judged(stand: Path) -> tuple[np.ndarray, np.ndarray]:
    """Simulated windows of the double-escape peak, and their true current amplitudes."""
    sim = open_pulses(stand / "sim.lh5").read()
    truth = np.load(stand / "truth.npz")
    prepared = prepare(sim, RECIPE.preparation, "simulated")
    rows = np.flatnonzero(truth["label"][prepared.index] == 0)[:1000]
    traces = truth["response"][prepared.index[rows]].astype(np.float32)
    windows = finish(traces, RECIPE.preparation, dt_ns=sim.dt_ns).windows
    return prepared.pulses.waveforms[rows], current_amplitude(windows, 16.0)


def shift(response: ElectronicsResponse, windows: np.ndarray, wanted: np.ndarray) -> float:
    """Median relative error of the translated current amplitude in percent."""
    return off(
        finish(response(windows), RECIPE.preparation, dt_ns=float(response.dt_ns)).windows,
        wanted,
    )


def off(translated: np.ndarray, wanted: np.ndarray) -> float:
    """Median relative error of current amplitudes in percent."""
    return 100 * float(np.nanmedian(np.log(current_amplitude(translated, 16.0) / wanted)))


def experiment(
    run: Path, sim: Pulses, windows: np.ndarray, noise
) -> tuple[Pulses, Pulses, np.ndarray]:
    """Half of the pulses, the others with a known response as data, and true amplitudes."""
    half, config = len(sim) // 2, RECIPE.preparation
    response = known_response(Run.load(run), RECIPE)
    kev = sim.energy_kev[half:]

    def records(pulses: np.ndarray) -> np.ndarray:
        return response(pulses)

    measured = finish(
        records(sim.waveforms[half:]),
        config,
        dt_ns=sim.dt_ns,
        noise=noise,
        energy_kev=kev,
        seed=1,
    ).windows
    data = Pulses.of(measured, dt_ns=sim.dt_ns, energy_kev=kev)
    true = finish(records(windows), config, dt_ns=sim.dt_ns).windows
    return sim[:half], data, current_amplitude(true, 16.0)


def band_of(sim: Pulses, data: Pulses, noise, rng) -> Band:
    moments = Moments.of_data(data.waveforms, TRAINING, RECIPE.preparation)
    length = record_length(sim.waveforms.shape[1], sim.dt_ns)
    drawn = Noise.draw(noise, sim.energy_kev, length, TRAINING.noise_sets, rng)
    rows = np.arange(len(sim))
    return Band("FEP", SimulatedSide(sim.waveforms, drawn, moments, np.ones(len(sim))), rows)


def readings(band: Band, response: ElectronicsResponse) -> torch.Tensor:
    """Readings of each pulse, as input of a network."""
    seen: list[Readings] = []
    threads = numba.get_num_threads()
    numba.set_num_threads(1)  # keeps the order of the pulses
    band.sim.sums(response, lambda r: (seen.append(r), (np.zeros(1),))[1], cut=False, draws=1)
    numba.set_num_threads(threads)
    linear = np.clip(np.concatenate([r.linear for r in seen]), -4, 4)
    logs = np.concatenate([r.log_amplitude for r in seen])
    middle, top = np.median(logs), np.quantile(logs, 0.9)
    near = np.clip((logs - top) / 0.01, -6, 6)
    wide = (logs - middle) / logs.std()
    return torch.from_numpy(np.column_stack([linear, wide, near])).float()


def bound(
    band: Band, response: ElectronicsResponse, direction: np.ndarray, pairs: float
) -> float:
    """Error of the shift in percent, from the best function that a network finds."""
    parameters = Parameters(response)
    vector, shifted = parameters.vector(), []
    for i, step in enumerate(0.01 * parameters.widths):
        ends = []
        for sign in (1, -1):
            moved = vector.copy()
            moved[i] += sign * step
            parameters.set(moved)
            ends.append(readings(band, response))
        shifted.append((ends[0], ends[1], 2 * step))
    parameters.set(vector)
    here = readings(band, response)
    width, n = here.shape[1], len(parameters.labels)
    torch.manual_seed(0)
    net = torch.nn.Sequential(
        torch.nn.Linear(width, 64), torch.nn.SiLU(), torch.nn.Linear(64, 64), torch.nn.SiLU(),
        torch.nn.Linear(64, n),
    )  # fmt: skip
    straight = torch.nn.Linear(width, n)
    prior = torch.diag(torch.from_numpy(parameters.widths**-2.0))
    wanted = torch.from_numpy(direction)

    def error(rows: torch.Tensor) -> torch.Tensor:
        def of(values: torch.Tensor) -> torch.Tensor:
            return net(values[rows]) + straight(values[rows])

        slopes = torch.stack([(of(a) - of(b)).mean(0) / d for a, b, d in shifted], dim=1)
        spread = torch.cov(of(here).T) + 1e-4 * torch.eye(n)
        told = (slopes.T @ torch.linalg.solve(spread, slopes)).double()
        return (wanted @ torch.linalg.solve(told * pairs + prior, wanted)).sqrt()

    learned, held = torch.arange(len(here)).split([len(here) // 2, len(here) - len(here) // 2])
    optimiser = torch.optim.Adam([*net.parameters(), *straight.parameters()], lr=2e-3)
    best = float("inf")
    for step in range(400):
        loss = error(learned[torch.randperm(len(learned))[:1500]]).log()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 50 == 49:
            with torch.no_grad():
                best = min(best, 100 * float(error(held)))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stand", type=Path)
    parser.add_argument("--pulses", type=int, default=3300)
    parser.add_argument("--sets", type=int, default=5)
    parser.add_argument(
        "--run", type=Path, help="folder of a run: its shift is printed, no more"
    )
    parser.add_argument(
        "--chain",
        type=Path,
        help="folder of a run whose response makes data with a known answer",
    )
    arguments = parser.parse_args()
    windows, wanted = judged(arguments.stand)
    if arguments.run is not None:
        translated = REN.load(arguments.run).apply(windows, noise=False)
        print(f"{arguments.run}: {off(translated, wanted):+.3f} %")
        return
    files = [PulseFile(arguments.stand / f"{side}.lh5") for side in ("sim", "data")]
    selection = parse_selection("FEP", RECIPE.peaks)
    sim = load_pulses(files[0], "simulated", RECIPE, selection).prepared.pulses
    measured = load_pulses(files[1], "measured", RECIPE, selection)
    data, noise = measured.prepared.pulses, noise_of(measured)
    if arguments.chain is not None:
        sim, data, wanted = experiment(arguments.chain, sim, windows, noise)
    sets = PulseSets(sim[:2000], data[:2000], noise, RECIPE, np.random.default_rng(0))
    start, _ = response_fit.fit_response(sets, Fitter(RECIPE.matching.training))
    state = {name: value.copy() for name, value in start.arrays().items()}
    shifts: dict[str, list[float]] = {"moments": [], "weighted": []}
    n = arguments.pulses
    for k in range(min(arguments.sets, len(sim) // n, len(data) // n)):
        rows = slice(k * n, (k + 1) * n)
        # with a ringing, if one was found
        response = ElectronicsResponse(start.config, sim.dt_ns)
        response.fill(state)
        band = band_of(sim[rows], data[rows], noise, np.random.default_rng(k))
        problem = ResponseProblem(response, [band])
        levenberg_marquardt(problem, 20, None, coarse=False)
        shifts["moments"].append(shift(response, windows, wanted))
        for _ in range(response_fit.ROUNDS):
            refine(problem, [band], TRAINING.conditional_bins)
        shifts["weighted"].append(shift(response, windows, wanted))
        print(
            k, *(f"{name} {values[-1]:+.3f} %" for name, values in shifts.items()), flush=True
        )
    for name, values in shifts.items():
        print(f"{name}: mean {np.mean(values):+.3f}, spread {np.std(values, ddof=1):.3f} %")
    parameters = Parameters(start)
    vector, here = parameters.vector(), shift(start, windows, wanted)
    direction = []
    for i, step in enumerate(0.01 * parameters.widths):
        moved = vector.copy()
        moved[i] += step
        parameters.set(moved)
        direction.append((shift(start, windows, wanted) - here) / (100 * step))
    parameters.set(vector)
    many = min(len(sim), len(data), 10_000)
    band = band_of(sim[:many], data[:many], noise, np.random.default_rng(0))
    print(f"bound: {bound(band, start, np.array(direction), n / 2):.3f} %")


if __name__ == "__main__":
    main()
