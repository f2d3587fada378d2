"""A small network that corrects a matched chain, trained on the same unpaired pulses.

The chain is frozen.  Its records, corrected and with noise, are compared with the data by the
weighted means of `cpunet.training.edge_functions`.  The correction must be smooth: means of
shapes do not exclude wiggles, which a classifier finds.  A part of both sets is held out:
unless its chi-square decreases clearly, the correction is set to zero.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cpunet.electronics.finishing import blocks
from cpunet.errors import CpunetError
from cpunet.networks.hybrid import EdgeResidual
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import FloatArray
from cpunet.recipes.network_settings import ResidualConfig
from cpunet.recipes.schema import Recipe
from cpunet.training.held_out import Aim, Kept, judge, split_rows
from cpunet.training.outside import of_height

DRAWS = 4  # noise traces per pulse; in training, they are assigned to pulses at random
PER_MILLE = 1e-3  # of a pulse's height: the unit of roughness


def fit_residual(
    generator: ResponseGenerator,
    sim: FloatArray,
    data: FloatArray,
    energy_kev: npt.NDArray[np.float64],
    recipe: Recipe,
    *,
    seed: int,
) -> tuple[EdgeResidual, Kept]:
    """Train a correction of a matched chain's records, and judge it on held-out pulses.

    Parameters
    ----------
    generator
        Matched chain with noise; it is not modified.
    sim, data
        Prepared windows, shapes (n, samples) and (n', samples).
    energy_kev
        Energies of the simulated pulses.
    recipe
        Recipe with a residual.
    seed
        Seed of the held-out pulses, the weights, the batches and the noise.

    Returns
    -------
    tuple
        The correction, exactly zero if it is not kept, and the result of its test.

    Raises
    ------
    TooFewPulsesError
        If too few measured pulses are left for the training.
    CpunetError
        If the training diverges.
    """
    config = recipe.residual
    rng = np.random.default_rng(seed)
    own, held = split_rows(len(sim), config.held_out, rng)
    own_data, held_data = split_rows(len(data), config.held_out, rng)
    records = _records(generator, sim, recipe)
    noise = torch.from_numpy(
        np.concatenate(
            [
                generator.trace_noise.draw(energy_kev, records.shape[1], rng)
                for _ in range(DRAWS)
            ]
        )
    )
    aim = Aim.at(data[own_data], recipe)
    trained = _train(no_residual(recipe, seed), aim, records[own], noise, config, rng)
    held_out = aim.at_others(data[held_data])
    dealt = noise[torch.from_numpy(rng.permutation(len(noise))[: len(held)])]
    found = judge(trained, held_out, records[held], dealt, config.least_fall, rng)
    if found.kept:
        trained.used.fill_(True)
    else:
        trained.clear()
    return trained.eval(), found


def no_residual(recipe: Recipe, seed: int) -> EdgeResidual:
    """A correction that is zero, with the weights from which its training starts."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return EdgeResidual(recipe.residual)


@torch.no_grad()
def _records(generator: ResponseGenerator, sim: FloatArray, recipe: Recipe) -> Tensor:
    """Noise-free records of the chain alone, with the height of prepared windows."""
    records = [generator.response(torch.from_numpy(sim[rows])) for rows in blocks(len(sim))]
    return of_height(torch.cat(records), recipe.preparation.tail_level)


def _train(
    network: EdgeResidual,
    aim: Aim,
    records: Tensor,
    noise: Tensor,
    config: ResidualConfig,
    rng: np.random.Generator,
) -> EdgeResidual:
    """Return the running average of the trained network."""
    average = get_ema_multi_avg_fn(config.average_decay)  # type: ignore[no-untyped-call]
    averaged = AveragedModel(network, multi_avg_fn=average)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=config.rate, weight_decay=config.weight_decay
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.iterations)
    size = min(config.batch_size, len(records))
    for i in range(config.iterations):
        rows = torch.from_numpy(rng.choice(len(records), size, replace=False))
        drawn = noise[torch.from_numpy(rng.choice(len(noise), size, replace=False))]
        corrected, added = network.corrected(records[rows])
        chi_square = aim.chi_square(aim.functions.of_records(corrected + drawn))
        rough = torch.diff(added / PER_MILLE, n=2, dim=1).square().mean()
        value = float(chi_square.detach())
        if not math.isfinite(value):
            raise CpunetError(
                f"the residual diverged in iteration {i + 1}; lower generator.residual.rate, "
                "or train without it (recipe fast)"
            )
        optimiser.zero_grad()
        (chi_square + config.roughness_weight * rough).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        averaged.update_parameters(network)
    trained = averaged.module
    assert isinstance(trained, EdgeResidual)
    return trained
