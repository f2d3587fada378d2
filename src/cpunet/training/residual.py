"""A small network beside a matched chain, trained on the same unpaired pulses.

The chain is frozen.  Its records, corrected and with noise, are compared with the data at
their half maximum: along many directions in the space of pulses and of their derivatives
(sliced Wasserstein distance; Bonneel et al., J. Math. Imaging Vis. 51 (2015) 22), and in the
density of the current amplitude.  What is added is penalised by its mean square.  A part of
both sets is held out: unless its distance falls clearly, the correction is made zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cpunet.errors import CpunetError
from cpunet.networks.hybrid import EdgeResidual
from cpunet.networks.response import PADDING_AFTER, PADDING_BEFORE
from cpunet.networks.response_generator import ResponseGenerator
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.recipes.network_settings import ResidualConfig
from cpunet.recipes.schema import Recipe
from cpunet.training.half_maximum import at_half_maximum
from cpunet.training.moments import BLOCK, EDGE, Moments
from cpunet.training.translated import DELAY

Listener = Callable[[int, float], None]

# Samples about the half maximum whose derivative is compared, and its principal components.
SLOPE_BEFORE, SLOPE_AFTER, SLOPE_COMPONENTS = 60, 90, 16
MAX_MIXED = 3  # features along one direction
QUANTILES = 256
JUDGED = 512  # directions along which the held-out sets are compared
DRAWS = 4  # of the noise; while training, these are dealt anew to the pulses
RESAMPLED = 60  # times, to tell a fall of the distance from chance
SURE = 2.5  # of its standard deviations
OUTLIER = 6.0  # standard deviations at which features end


@dataclass(frozen=True)
class Kept:
    """What became of a correction.

    Parameters
    ----------
    kept
        Whether it is used.
    rms
        Of what it adds to the stretch about the half maximum, in pulse heights; 0 if unused.
    held_out_before, held_out_after
        Distance of the held-out sets without and with it.
    """

    kept: bool
    rms: float
    held_out_before: float
    held_out_after: float


class Features:
    """What is compared of pulses: components of shape and slope, and the current amplitude.

    Parameters
    ----------
    data
        Prepared measured windows, shape (n, samples), to which all features are scaled.
    recipe
        With a response to be matched.
    """

    def __init__(self, data: FloatArray, recipe: Recipe) -> None:
        self.training, self.preparation = recipe.matching.training, recipe.preparation
        self.moments = Moments.of_data(data, self.training, recipe.preparation)
        self.middle, self.components = map(
            torch.from_numpy, (self.moments.mean, self.moments.components)
        )
        centres, widths = self.moments.amplitude_centres, self.moments.amplitude_widths
        self.bins = torch.from_numpy(np.stack([centres, widths])).float()
        self.kernel = torch.from_numpy(current_amplitude_kernel())
        aligned = self._aligned(torch.from_numpy(data), self.preparation.samples_before + 1)
        aligned = aligned[torch.isfinite(aligned).all(dim=1)]
        slopes = self._slopes(aligned)
        self.mean = slopes.mean(dim=0)
        _, sizes, axes = torch.linalg.svd(slopes - self.mean, full_matrices=False)
        self.axes = axes[:SLOPE_COMPONENTS].T / (sizes[:SLOPE_COMPONENTS] / len(slopes) ** 0.5)
        logs = self._amplitudes(aligned).log()
        middle = logs.median()
        self.scale = torch.stack([middle, (logs - middle).abs().mean()])
        _, density = self._of(aligned)
        self.errors = density.std(dim=0).clamp_min(1e-3)

    def of_windows(self, windows: FloatArray) -> tuple[Tensor, Tensor]:
        """Features, and density of the amplitude, of prepared measured windows."""
        windows = np.ascontiguousarray(windows)
        found = self._aligned(torch.from_numpy(windows), self.preparation.samples_before + 1)
        return self._of(found[torch.isfinite(found).all(dim=1)])

    def of_records(self, records: Tensor) -> tuple[Tensor, Tensor]:
        """The same of records with noise, of about the height of prepared ones."""
        last = PADDING_BEFORE + self.preparation.samples_before + DELAY
        return self._of(self._aligned(records, last))

    def _aligned(self, records: Tensor, last: int) -> Tensor:
        level = self.preparation.tail_level
        return at_half_maximum(records, self.moments.level, last, self.training, level)[0]

    def _of(self, aligned: Tensor) -> tuple[Tensor, Tensor]:
        shape = (aligned - self.middle) @ self.components
        slope = (self._slopes(aligned) - self.mean) @ self.axes
        logs = self._amplitudes(aligned).clamp_min(1e-4).log()
        amplitude = ((logs - self.scale[0]) / self.scale[1])[:, None]
        features = torch.cat([shape, slope, amplitude], dim=1).clamp(-OUTLIER, OUTLIER)
        bins = (logs[:, None] - self.bins[0]) / self.bins[1]
        return features, torch.exp(-0.5 * bins**2)

    def _slopes(self, aligned: Tensor) -> Tensor:
        before = self.training.before
        return torch.diff(aligned[:, before - SLOPE_BEFORE : before + SLOPE_AFTER], dim=1)

    def _amplitudes(self, aligned: Tensor) -> Tensor:
        before = self.training.before
        current = torch.diff(aligned[:, before - EDGE : before + EDGE], dim=1)
        phases = nn.functional.conv1d(current[:, None], self.kernel[:, None])
        return phases.flatten(1).amax(dim=1)


class Distance:
    """How far translated pulses are from a measured set, in its features.

    Parameters
    ----------
    features
        And their scale.
    data
        Prepared measured windows, shape (n, samples).
    amplitude_weight
        Of the density of the current amplitude.
    """

    def __init__(self, features: Features, data: FloatArray, amplitude_weight: float) -> None:
        self.features, self.weight = features, amplitude_weight
        self.values, density = features.of_windows(data)
        self.density = density.mean(dim=0)

    def __call__(self, records: Tensor, directions: Tensor) -> Tensor:
        """Of records with noise, along directions of shape (features, n)."""
        values, density = self.features.of_records(records)
        usable = torch.isfinite(values).all(dim=1)
        if not usable.any():
            return values.new_tensor(math.nan)
        apart = quantiles(values[usable] @ directions) - quantiles(self.values @ directions)
        off = (density[usable].mean(dim=0) - self.density) / self.features.errors
        return apart.square().mean() + self.weight * off.square().mean()


def quantiles(values: Tensor) -> Tensor:
    """Evenly spaced quantiles of each column, shape (QUANTILES, columns)."""
    place = (torch.arange(QUANTILES) + 0.5) / QUANTILES * len(values) - 0.5
    place = place.clamp(0, len(values) - 1)
    low = place.floor().long()
    share = (place - low)[:, None]
    ordered = values.sort(dim=0).values
    high = (low + 1).clamp(max=len(values) - 1)
    between: Tensor = ordered[low] * (1 - share) + ordered[high] * share
    return between


def directions_of(n: int, features: int, generator: torch.Generator) -> Tensor:
    """Random directions that mix one to `MAX_MIXED` features, shape (features, n)."""
    mixed = torch.randint(1, MAX_MIXED + 1, (n,), generator=generator)
    order = torch.rand((features, n), generator=generator).argsort(dim=0).argsort(dim=0)
    weights = torch.randn((features, n), generator=generator) * (order < mixed)
    directions: Tensor = weights / weights.norm(dim=0).clamp_min(1e-6)
    return directions


def fit_residual(
    generator: ResponseGenerator,
    sim: FloatArray,
    data: FloatArray,
    energy_kev: npt.NDArray[np.float64],
    recipe: Recipe,
    *,
    seed: int,
    listener: Listener | None = None,
) -> tuple[EdgeResidual, Kept]:
    """Train a correction of a matched chain's records, and judge it on held-out pulses.

    Parameters
    ----------
    generator
        The matched chain, with noise; it is left as it is.
    sim, data
        Prepared windows, shapes (n, samples) and (n', samples).
    energy_kev
        Of the simulated pulses.
    recipe
        With a residual.
    seed
        Of the held-out pulses, the weights, the batches and the noise.
    listener
        Told the iteration and its distance.

    Returns
    -------
    tuple
        The correction, exactly zero if it is not kept, and what became of it.

    Raises
    ------
    CpunetError
        If there are too few pulses, or the training diverges.
    """
    config = recipe.residual
    rng = np.random.default_rng(seed)
    own, held = _split(len(sim), config.held_out, rng)
    own_data, held_data = _split(len(data), config.held_out, rng)
    records = _records(generator, sim, recipe)
    noise = torch.from_numpy(
        np.concatenate(
            [
                generator.trace_noise.draw(energy_kev, records.shape[1], rng)
                for _ in range(DRAWS)
            ]
        )
    )
    features = Features(data[own_data], recipe)
    distance = Distance(features, data[own_data], config.amplitude_weight)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = EdgeResidual(config)
    trained = _train(network, distance, records[own], noise, config, rng, listener)
    judge = _Judge(features, data[held_data], records[held], noise, rng)
    before, after, sure = judge.compare(trained)
    kept = sure and after < (1 - config.least_fall) * before
    if not kept:
        trained.clear()
        return trained.eval(), Kept(False, 0.0, before, after)
    trained.used.fill_(True)
    with torch.no_grad():
        _, added = trained.corrected(records)
    return trained.eval(), Kept(True, float(added.square().mean().sqrt()), before, after)


def _split(
    n: int, share: float, rng: np.random.Generator
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows to train on, and rows held out."""
    order = rng.permutation(n)
    held = max(1, round(share * n))
    return np.sort(order[held:]), np.sort(order[:held])


@torch.no_grad()
def _records(generator: ResponseGenerator, sim: FloatArray, recipe: Recipe) -> Tensor:
    """Noise-free records of the chain alone, as high as prepared windows."""
    records = torch.cat(
        [
            generator.response(torch.from_numpy(sim[first : first + BLOCK]))
            for first in range(0, len(sim), BLOCK)
        ]
    )
    plateau = records[:, -PADDING_AFTER : -PADDING_AFTER + 100].mean(dim=1, keepdim=True)
    scaled: Tensor = records * (recipe.preparation.tail_level / plateau)
    return scaled


def _train(
    network: EdgeResidual,
    distance: Distance,
    records: Tensor,
    noise: Tensor,
    config: ResidualConfig,
    rng: np.random.Generator,
    listener: Listener | None,
) -> EdgeResidual:
    """Return the running average of the trained network."""
    average = get_ema_multi_avg_fn(config.average_decay)  # type: ignore[no-untyped-call]
    averaged = AveragedModel(network, multi_avg_fn=average)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.rate)
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    features, size = distance.values.shape[1], min(config.batch_size, len(records))
    for i in range(config.iterations):
        for group in optimiser.param_groups:
            group["lr"] = 0.5 * config.rate * (1 + math.cos(math.pi * i / config.iterations))
        rows = torch.from_numpy(rng.choice(len(records), size, replace=False))
        drawn = noise[torch.from_numpy(rng.choice(len(noise), size, replace=False))]
        corrected, added = network.corrected(records[rows])
        directions = directions_of(config.projections, features, generator)
        apart = distance(corrected + drawn, directions)
        loss = apart + config.size_weight * added.square().mean()
        loss = loss + config.slope_weight * torch.diff(added, dim=1).square().mean()
        value = float(apart.detach())
        if not math.isfinite(value):
            raise CpunetError(
                f"the residual diverged in iteration {i + 1}; lower generator.residual.rate, "
                "or train without it (recipe fast)"
            )
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        averaged.update_parameters(network)
        if listener is not None:
            listener(i + 1, value)
    trained = averaged.module
    assert isinstance(trained, EdgeResidual)
    return trained


class _Judge:
    """Compares held-out sets with and without a correction, chance allowed for."""

    def __init__(
        self,
        features: Features,
        data: FloatArray,
        records: Tensor,
        noise: Tensor,
        rng: np.random.Generator,
    ) -> None:
        self.features, self.rng = features, rng
        self.data, _ = features.of_windows(data)
        self.records = records
        self.noise = noise[torch.from_numpy(rng.permutation(len(noise))[: len(records)])]
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        self.directions = directions_of(JUDGED, self.data.shape[1], generator)

    @torch.no_grad()
    def compare(self, network: EdgeResidual) -> tuple[float, float, bool]:
        """Distances before and after, and whether the fall is more than chance."""
        values = [
            self.features.of_records(records + self.noise)[0] @ self.directions
            for records in (self.records, network.corrected(self.records)[0])
        ]
        usable = torch.isfinite(values[0]).all(dim=1) & torch.isfinite(values[1]).all(dim=1)
        before, after = (v[usable] for v in values)
        data = self.data @ self.directions
        falls = []
        for _ in range(RESAMPLED):
            rows = torch.from_numpy(self.rng.integers(0, len(before), len(before)))
            other = torch.from_numpy(self.rng.integers(0, len(data), len(data)))
            wanted = quantiles(data[other])
            falls.append(_apart(before[rows], wanted) - _apart(after[rows], wanted))
        spread = float(np.std(falls, ddof=1))
        wanted = quantiles(data)
        first, last = _apart(before, wanted), _apart(after, wanted)
        return first, last, first - last > SURE * spread


def _apart(values: Tensor, wanted: Tensor) -> float:
    return float((quantiles(values) - wanted).square().mean())
