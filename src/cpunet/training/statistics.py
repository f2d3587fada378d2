"""Batch-norm statistics of what a generator will really be asked to translate.

In training a generator sees pulses of both sides (identity and cycle losses), and
the running averages of its batch norms are a mixture of both. Used for one side
alone they shift the output: with them the tail slope of a translation is wrong by
more than its spread. After the training the averages are taken anew over the
generator's own input side (Wu and Johnson 2021, arXiv:2105.07576, section 3).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torch import Tensor, nn
from torch.optim.swa_utils import update_bn

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
        Pulses of the side that it translates; in a group, that of the batch norms.
    batches
        How many batches to average over.
    run
        Where the network stands behind a chain, both of windows of shape (batch, samples).
    """
    batch = (sampler.next_batch() for _ in range(batches))
    update_bn(batch, network if run is None else _Behind(network, run))


class _Behind(nn.Module):
    """A network that is run behind something else."""

    def __init__(self, network: nn.Module, run: Callable[[Tensor], object]) -> None:
        super().__init__()
        self.network = network
        self.run = partial(run)  # bare, a module would be set to train, too
        self.training = network.training

    def forward(self, pulses: Tensor) -> object:
        """Run it on pulses of shape (batch, 1, samples)."""
        return self.run(pulses[:, 0])
