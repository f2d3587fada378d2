"""Batch-norm statistics of the pulses that a generator will translate.

In training a generator sees pulses of both sides (identity and cycle losses), and
the running averages of its batch norms are a mixture of both. Used for one side
alone they shift the output: with them the tail slope of a translation is wrong by
more than its spread. After the training the averages are computed again over the
generator's own input side (Wu and Johnson 2021, arXiv:2105.07576, section 3).

Dropout is off meanwhile, as in a translation: with it the variance at the batch norms behind
it is larger, here by up to a sixth (Li et al. 2019, CVPR, "variance shift").
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
        Sampler of the side that it translates.
    batches
        How many batches to average over.
    run
        If the network follows a chain: both together, for windows of shape (batch, samples).
    """
    batch = (sampler.next_batch() for _ in range(batches))
    with _without_dropout(network):
        update_bn(batch, network if run is None else _Behind(network, run))


@contextmanager
def _without_dropout(network: nn.Module) -> Iterator[None]:
    """Set all fractions to 0, since `update_bn` switches every module to training mode."""
    layers = [module for module in network.modules() if isinstance(module, nn.Dropout)]
    fractions = [layer.p for layer in layers]
    try:
        for layer in layers:
            layer.p = 0.0
        yield
    finally:
        for layer, fraction in zip(layers, fractions, strict=True):
            layer.p = fraction


class _Behind(nn.Module):
    """A network that is run by a function, such as one that applies a chain first."""

    def __init__(self, network: nn.Module, run: Callable[[Tensor], object]) -> None:
        super().__init__()
        self.network = network
        self.run = partial(run)  # a bare module would be switched to training mode, too
        self.training = network.training

    def forward(self, pulses: Tensor) -> object:
        """Run it on pulses of shape (batch, 1, samples)."""
        return self.run(pulses[:, 0])
