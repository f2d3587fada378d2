"""How well a fit determines the current amplitude.

Run with ``python benchmarks/information.py STAND --pulses 3300``; STAND has many full-energy
pulses on both sides, and the truth.  It is split into sets of that many pulses.  Each is
fitted, and the shift of the translated current amplitude of the double-escape peak from the
truth is printed.

``python benchmarks/information.py STAND --run RUN`` prints only the shift of a run.  With
``--chain RUN`` the data are simulated experiments: half of the stand's simulated pulses, with
the response of a run and noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import finish
from cpunet.electronics.measured import noise_of
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.pulses.container import Pulses
from cpunet.pulses.loading import load_pulses
from cpunet.pulses.parameters import current_amplitude
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.preparation import prepare
from cpunet.pulses.reading.files import PulseFile, open_pulses
from cpunet.recipes import load_recipe
from cpunet.training.chain_fit import Fitter
from cpunet.training.pulse_sets import PulseSets
from cpunet.training.response_fit import fit_response
from cpunet.training.run import Run
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
    run: Path, sim: Pulses, windows: np.ndarray, noise: BaselineNoise
) -> tuple[Pulses, Pulses, np.ndarray]:
    """Half of the pulses, the others with a known response as data, and true amplitudes."""
    half, config = len(sim) // 2, RECIPE.preparation
    known = Run.load(run)
    chain = ResponseGenerator(known.recipe.matching.generator, known.dt_ns)
    response = known.fill("ren", chain).response
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
    shifts, n = [], arguments.pulses
    for k in range(min(arguments.sets, len(sim) // n, len(data) // n)):
        rows = slice(k * n, (k + 1) * n)
        sets = PulseSets(sim[rows], data[rows], noise, RECIPE, np.random.default_rng(k))
        response, _ = fit_response(sets, Fitter(RECIPE.matching.training))
        shifts.append(shift(response, windows, wanted))
        print(f"{k} {shifts[-1]:+.3f} %", flush=True)
    print(f"mean {np.mean(shifts):+.3f}, spread {np.std(shifts, ddof=1):.3f} %")


if __name__ == "__main__":
    main()
