"""Noise outside the generators, and the preparation of noisy pulses.

A generator makes a pulse without noise.  Before a discriminator or a score sees it, noise drawn
from the data's own baselines is added, and the noisy record is prepared like a measured trace,
so that noise affects alignment, baseline and scale like those of the data.  The position of
the window is found without gradients; baseline and scale are differentiable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cpunet.electronics.drawn_tails import TraceNoise
from cpunet.electronics.finishing import PADDING_AFTER, PADDING_BEFORE
from cpunet.networks.generators import stretch
from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import PreparationConfig

MIN_SCALE = 1e-3
TOLERATED = 3.0  # deviation of a cycle that is ignored, in RMS of the pulse's own baseline


@dataclass(frozen=True, eq=False)
class Outside:
    """Noise and preparation for the translations of a set of simulated pulses.

    Parameters
    ----------
    noise
        Noise of the data's baselines.
    energy_kev
        Energies of the simulated pulses, shape (n,); noise scales as 1/energy.
    preparation
        Preparation of the data.
    """

    noise: TraceNoise
    energy_kev: npt.NDArray[np.float64]
    preparation: PreparationConfig

    def add_noise(self, records: Tensor, rows: Tensor) -> Tensor:
        """Add noise to records of prepared height, and prepare them, shape (batch, 1, samples).

        Parameters
        ----------
        records
            Noise-free records with padding around the window, shape (batch, samples).
        rows
            Indices of the simulated pulses.
        """
        # seeded by torch, whose random state is part of a checkpoint
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        energies = self.energy_kev[rows.cpu().numpy()]
        drawn = self.noise.draw(energies, records.shape[1], rng)
        noisy = records + torch.from_numpy(drawn).to(records)
        return as_measured(noisy, self.preparation, self.noise.dt_ns)

    def noisy_windows(self, windows: Tensor, rows: Tensor) -> Tensor:
        """Windows as a network makes them, (batch, 1, samples), with noise like the data."""
        return self.add_noise(in_room(windows[:, 0], self.preparation), rows)


def in_room(windows: Tensor, config: PreparationConfig) -> Tensor:
    """Extend windows as `cpunet.electronics.finishing.with_room` does, with gradients.

    Noise makes some windows begin later.  The samples that set the scale of a whole pulse then
    lie in the extension, so level and slope of the decay must have their gradients.
    """
    last = windows[:, -config.decay_fit_samples :].double()
    usable = (last > 0).all(dim=1, keepdim=True)  # else the slope is 0
    lever = torch.arange(config.decay_fit_samples).to(last)
    lever = lever - lever.mean()
    slope = torch.where(usable, last, 1).log() @ (lever / lever.square().sum())
    # the mean of the last samples is the level at their centre
    since = torch.arange(PADDING_AFTER).to(last) + 0.5 * (config.tail_samples + 1)
    level = last[:, -config.tail_samples :].mean(dim=1, keepdim=True)
    after = level * (slope[:, None] * since).exp()
    return torch.cat(
        [windows.new_zeros(len(windows), PADDING_BEFORE), windows, after.to(windows)], dim=1
    )


def as_measured(records: Tensor, config: PreparationConfig, dt_ns: float) -> Tensor:
    """Prepare records like measured traces, with gradients for all but the alignment.

    A record that cannot be prepared, as may happen early in a training, is cut at the nominal
    position.
    """
    raw = Pulses.of(records.detach().cpu().numpy(), dt_ns=dt_ns)
    prepared = prepare(
        raw, config.model_copy(update={"saturation_run": raw.length}), "measured"
    )
    align = np.full(len(records), PADDING_BEFORE + config.samples_before)
    align[prepared.index] = prepared.align_sample
    start = torch.from_numpy(align - config.samples_before).to(records.device)
    windows = stretch(records, start, 0, config.length)
    windows = windows - windows[:, : config.baseline_samples].mean(dim=1, keepdim=True)
    level = windows[:, -config.tail_samples :].mean(dim=1, keepdim=True)
    scale = (level / config.tail_level).clamp_min(MIN_SCALE)
    return (windows / scale)[:, None]


def tolerance(data: Tensor, config: PreparationConfig) -> Tensor:
    """Tolerance for the noise of each measured pulse, shape (batch, 1, 1).

    A cycle that starts from a measured pulse cannot reproduce its noise, which generators do
    not make.  Deviations within this tolerance are therefore ignored.
    """
    return TOLERATED * data[..., : config.baseline_samples].std(dim=-1, keepdim=True)
