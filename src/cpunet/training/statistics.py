"""Batch-norm statistics of what a generator will really be asked to translate.

In training a generator sees pulses of both sides (identity and cycle losses), and
the running averages of its batch norms are a mixture of both. Used for one side
alone they shift the output: with them the tail slope of a translation is wrong by
more than its spread. After the training the averages are taken anew over the
generator's own input side (Wu and Johnson 2021, arXiv:2105.07576, section 3).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from cpunet.training.sampling import EpochSampler


def refresh_batch_statistics(
    network: nn.Module,
    sampler: EpochSampler,
    batches: int,
    run: Callable[[Tensor], object] | None = None,
) -> None:
    """Replace the running statistics of all batch norms by plain averages.

    Parameters
    ----------
    network
        A generator; its mode (training or evaluation) is left as it was.
    sampler
        Pulses of the side that it translates; in a team, that of the batch norms.
    batches
        How many batches to average over.
    run
        Where the network stands behind a chain, both of windows of shape (batch, samples).
    """
    norms = [m for m in network.modules() if isinstance(m, nn.BatchNorm1d)]
    momenta = [norm.momentum for norm in norms]
    training = network.training
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a plain average over all batches
    network.train()
    with torch.no_grad():
        for _ in range(batches):
            pulses = sampler.next_batch()
            network(pulses) if run is None else run(pulses[:, 0])
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    network.train(training)
