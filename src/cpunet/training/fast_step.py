"""The passes of a training step, combined into fewer and faster ones with the same results.

On a CPU, convolutions take most of the time of a step, and the GRUs of the discriminators most
of the rest.  Independent passes of a generator run together in `cpunet.networks.time_major`,
each with its own batch statistics; the steps of a GRU are one compiled loop
(`cpunet.networks.gru_walk`).  On a GPU, cuDNN is faster.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from cpunet.networks.gru_discriminator import GruDiscriminator
from cpunet.networks.gru_walk import walk
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.networks.time_major import translate
from cpunet.training.generator_pass import Pass


class Translations(NamedTuple):
    """Results of the six passes of the generators."""

    fake_data: Tensor
    fake_sim: Tensor
    same_data: Tensor
    same_sim: Tensor
    cycled_sim: Tensor
    cycled_data: Tensor


def plain_translations(ren: Pass, iren: Pass, sim: Tensor, data: Tensor) -> Translations:
    """The six passes one by one."""
    fake_data, fake_sim = ren(sim), iren(data)
    return Translations(
        fake_data, fake_sim, ren(data), iren(sim), iren(fake_data), ren(fake_sim)
    )


def fast_translations(
    ren: PositionalUNet, iren: PositionalUNet, sim: Tensor, data: Tensor
) -> Translations:
    """The six passes in four."""
    fake_data, same_data = translate(ren, sim, data)
    fake_sim, same_sim = translate(iren, data, sim)
    (cycled_sim,), (cycled_data,) = translate(iren, fake_data), translate(ren, fake_sim)
    return Translations(fake_data, fake_sim, same_data, same_sim, cycled_sim, cycled_data)


def logits(network: nn.Module, pulses: Tensor) -> Tensor:
    """Logits of a discriminator for pulses; they may have no second derivative."""
    quick = pulses.device.type == "cpu" and pulses.dtype == torch.float32
    if quick and isinstance(network, GruDiscriminator):
        return network.judged(*walk(network.gru, network.read(pulses)))
    result: Tensor = network(pulses)
    return result
