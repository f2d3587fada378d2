"""What the published generator could reach: a Positional U-Net taught by pairs, for diagnosis.

Run with ``python benchmarks/unet_by_pairs.py STAND --width 8 --steps 4000``; a stand is a
folder with sim.lh5, data.lh5 and truth.npz.  The U-Net learns the true noise-free response of
each simulated full-energy pulse by the weighted L1 loss of recipe ``published``.  No unpaired
training can tell it more.  Escape peaks are only scored, with noise from the baselines.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch
from torch.optim import AdamW
from torch.optim.lr_scheduler import CosineAnnealingLR

from cpunet.electronics.finishing import finish
from cpunet.electronics.measured import trace_noise
from cpunet.networks.generators import KeptNoise
from cpunet.processes import keep_freed_memory
from cpunet.pulses.loading import InputSet, SideInfo, load_pulses
from cpunet.pulses.peaks import parse_selection
from cpunet.pulses.reading.files import PulseFile
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.training.adversarial import weighted_l1, window_weights
from cpunet.training.network_runs import generators, settle
from cpunet.training.run import Run, versions
from cpunet.training.views import Side
from cpunet.validation.comparisons import Missing
from cpunet.validation.methods import true_responses
from cpunet.validation.validate import evaluate

PEAK = "FEP"
REPORTS = 10


def taught(
    sim: InputSet, data: InputSet, truth: Path, recipe: Recipe, given: argparse.Namespace
) -> Run:
    """Return a run whose REN has learned the true response of the simulated pulses."""
    torch.manual_seed(0)
    noise, _ = trace_noise(data, recipe.preparation)
    wanted = finish(true_responses(truth, sim), recipe.preparation, dt_ns=sim.dt_ns).clean
    side = Side.of(sim.prepared.pulses, 0.0, seed=0)
    targets = Side.of(sim.prepared.pulses.with_waveforms(wanted), 0.0, seed=0).pulses
    config, steps, made = recipe.cyclegan.training, given.steps, generators(recipe)
    ren, weights = made["ren"].train(), window_weights(config.losses, recipe.preparation.length)
    optimiser = AdamW(ren.parameters(), given.rate)
    schedule = CosineAnnealingLR(optimiser, steps)
    start = time.perf_counter()
    for step in range(1, steps + 1):
        rows = side.draw(config.batch_size)
        loss = weighted_l1(ren(side.pulses[rows]) - targets[rows], weights)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        if step % (steps // REPORTS) == 0:
            seconds = time.perf_counter() - start
            print(f"{step:6d} steps, {seconds:5.0f} s: L1 {float(loss.detach()):.4f}")
    settle(ren, side, config)
    kept = KeptNoise(sim.dt_ns)
    kept.set_noise(noise)
    return Run.of(
        {"ren": ren.unet.eval(), "noise": kept},
        recipe,
        peak=PEAK,
        seed=0,
        dt_ns=sim.dt_ns,
        seconds=time.perf_counter() - start,
        device="cpu",
        sim=SideInfo(file=str(sim.path), used=str(len(side.pulses))),
        data=SideInfo(file=str(data.path), used=str(len(data.prepared.pulses))),
        versions=versions(),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("stand", type=Path)
    parser.add_argument("--width", type=int, default=8)
    parser.add_argument("--dropout", type=float, default=0.1)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--rate", type=float, default=2e-3)
    given = parser.parse_args()
    keep_freed_memory()
    settings = {"generator.width": given.width, "generator.dropout": given.dropout}
    recipe = load_recipe("published", settings | {"training.noise": "baselines"}).at(16)
    files = PulseFile(given.stand / "sim.lh5"), PulseFile(given.stand / "data.lh5")
    chosen, truth = parse_selection(PEAK, recipe.peaks), given.stand / "truth.npz"
    sim = load_pulses(files[0], "simulated", recipe, chosen)
    data = load_pulses(files[1], "measured", recipe, chosen)
    run = taught(sim, data, truth, recipe, given)
    metrics = evaluate(run, *files, truth=truth, baselines=False).metrics
    print(f"width {given.width}, dropout {given.dropout}, {given.steps} steps")
    for name, scores in metrics.peaks.items():
        overlaps = [
            f"{parameter} {compared.iou['ren']:.1f}"
            for parameter, compared in scores.parameters.items()
        ]
        tested, edge = scores.two_sample["ren"], scores.paired["ren"].edge_rmse or math.nan
        auc = math.nan if isinstance(tested, Missing) else tested.auc
        print(f"{name}: {', '.join(overlaps)}, AUC {auc:.2f}, edge RMSE {1e3 * edge:.2f}e-3")


if __name__ == "__main__":
    main()
