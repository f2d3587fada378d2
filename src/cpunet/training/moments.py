"""What is compared of two unpaired sets: means over events of many functions of a pulse.

Means of stretches of the pulse, of principal components and their squares, of the
density of the current amplitude and of the tail slope.  With their covariance from the
data's own events, the distance of two sets is a chi-square: a direction in which events
differ much by their physics counts little, one in which only noise moves them counts much
(generalised method of moments; Hansen, Econometrica 50 (1982) 1029).  The density of the
current amplitude is there in narrow bins because its sharp features, such as the edge of
the single-site events, fix the bandwidth four times better than its mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from cpunet.errors import CpunetError
from cpunet.pulses.container import FloatArray
from cpunet.pulses.parameters import current_amplitude_kernel
from cpunet.recipes.schema import PreparationConfig
from cpunet.recipes.training_settings import MatchingConfig
from cpunet.training.half_maximum import at_half_maximum

SIGMA_PER_MAD = 1.4826
FEWEST = 200  # pulses for a covariance of about a hundred moments
EDGE = 60  # samples to either side of the half maximum hold the steepest point
# Up to this sample from the half maximum the physics of drift shape a pulse, later on the
# electronics do; so many standard deviations off may the moments be where it is wrong.
EARLY, WRONG, LATE = 30, 20.0, 2.0
LEAST_SHARE = 0.2  # of the median amplitude: what is below is no single pulse
# Of translated pulses, beyond which the cut on the data's tails is no longer followed: the
# response is still far off.
MOST_CUT = 0.2


@dataclass(frozen=True, eq=False)
class Moments:
    """The functions whose means are compared, drawn up from the measured set.

    Use `of_data`; `of_records` then gives the functions of any set.

    Parameters
    ----------
    values
        Functions of the measured pulses, shape (pulses, moments), float64.
    names
        Of the moments.
    left_out
        Measured pulses that are no single pulses with a flat baseline, and do not count.
    slope_range
        Lowest and highest tail slope of the data.  Quality cuts bound it, and what is beyond
        is left out on the other side too: behind a fast decay the tails of late pulses are
        steeper, so that such a cut takes more of these.
    """

    config: MatchingConfig
    preparation: PreparationConfig
    level: float
    kernel: Tensor
    segments: Tensor
    components: Tensor
    mean: Tensor
    centres: Tensor
    spreads: Tensor
    amplitude_centres: Tensor
    amplitude_widths: Tensor
    values: Tensor
    names: tuple[str, ...]
    left_out: int
    slope_range: tuple[float, float]

    @classmethod
    def of_data(
        cls, windows: FloatArray, config: MatchingConfig, preparation: PreparationConfig
    ) -> Moments:
        """Draw up the moments from prepared measured pulses, shape (pulses, samples).

        Raises
        ------
        CpunetError
            If there are too few pulses.
        """
        data = torch.from_numpy(np.ascontiguousarray(windows))
        whole = torch.isfinite(data).all(dim=1)
        level = 0.5 * float(data[whole].mean(dim=0).max())
        aligned, records = at_half_maximum(
            data, level, preparation.samples_before + 1, config, preparation.tail_level
        )
        kernel = torch.from_numpy(current_amplitude_kernel())
        amplitude = _amplitude(aligned, kernel, config.before)
        quiet = aligned[:, : max(1, config.before // 4)].mean(dim=1).abs()
        usable = whole & torch.isfinite(aligned).all(dim=1) & (quiet < 0.05)
        usable &= amplitude > LEAST_SHARE * amplitude[usable].median()
        if usable.sum() < FEWEST:
            raise CpunetError(
                f"{int(usable.sum())} measured pulses can be used; {FEWEST} or more are "
                "needed: select more energies (--peak) or give more files"
            )
        aligned, records, amplitude = aligned[usable], records[usable], amplitude[usable].log()
        mean = aligned.mean(dim=0)
        _, sizes, axes = torch.linalg.svd(aligned - mean, full_matrices=False)
        components = axes[: config.components].T / (
            sizes[: config.components] / len(aligned) ** 0.5
        )
        edges = torch.quantile(
            amplitude, torch.linspace(0.02, 0.995, config.amplitude_bins + 1)
        )
        segments = _segments(config, aligned.shape[1])
        linear = torch.cat(
            [
                aligned @ segments,
                (aligned - mean) @ components,
                _tail_slopes(records, preparation)[:, None],
            ],
            dim=1,
        )
        centres = linear.median(dim=0).values
        spreads = SIGMA_PER_MAD * (linear - centres).abs().median(dim=0).values
        drawn_up = cls(
            config=config,
            preparation=preparation,
            level=level,
            kernel=kernel,
            segments=segments,
            components=components,
            mean=mean,
            centres=centres,
            spreads=spreads.clamp_min(1e-9),
            amplitude_centres=0.5 * (edges[1:] + edges[:-1]),
            amplitude_widths=(edges[1:] - edges[:-1]).clamp_min(config.amplitude_width),
            values=torch.empty(0),
            names=_names(config),
            left_out=int((~usable).sum()),
            slope_range=(float(linear[:, -1].min()), float(linear[:, -1].max())),
        )
        values = drawn_up._of_aligned(aligned, linear[:, -1])
        return cls(**{**vars(drawn_up), "values": values})

    def of_records(self, records: Tensor, last: int, clip: float | None = None) -> Tensor:
        """Functions of each pulse.

        Parameters
        ----------
        records
            Shape (pulses, samples), of about the height of prepared ones, with noise.
        last
            Sample after all half maxima.
        clip
            In place of the recipe's: wider far from the data, where all would be clipped.

        Returns
        -------
        Tensor
            Float64, shape (pulses, moments); NaN for a pulse that does not count.
        """
        tail_level = self.preparation.tail_level
        aligned, records = at_half_maximum(records, self.level, last, self.config, tail_level)
        slopes = self._slopes_of(records, last)
        values = self._of_aligned(aligned, slopes, clip)
        cut = (slopes < self.slope_range[0]) | (slopes > self.slope_range[1])
        if clip is None and cut.float().mean() < MOST_CUT:
            values[cut] = torch.nan
        return values

    @property
    def model_errors(self) -> Tensor:
        """Errors of the moments, in their standard deviations, if the physics are wrong."""
        edges = self.config.segments
        early = [stop <= EARLY for stop in edges[1:]]
        errors = [
            *(WRONG if e else LATE for e in early),
            *[WRONG] * self.config.components,
            0.0,
        ]
        errors += [WRONG] * self.config.squares
        errors += [0.0] * (len(self.names) - len(errors))
        return torch.tensor(errors, dtype=torch.float64)

    @property
    def slope(self) -> Tensor:
        """Median slope per sample of the logarithm of the data's tails."""
        return self.centres[-1]

    def _slopes_of(self, records: Tensor, first: int) -> Tensor:
        """Tail slopes where the preparation would align each record."""
        before = self.preparation.samples_before
        top = records[:, first - before : first + self.preparation.samples_after]
        highest, at = top.max(dim=1)
        index = torch.arange(top.shape[1], device=top.device)
        threshold = self.preparation.align_fraction * highest
        below = (top < threshold[:, None]) & (index < at[:, None])
        align = (below * (index + 1)).amax(dim=1) + first - before
        stop = self.preparation.samples_after
        start = stop - self.preparation.decay_fit_samples
        window = align[:, None] + torch.arange(start, stop, device=top.device)
        tail = records.gather(1, window.clamp(max=records.shape[1] - 1))
        return tail.clamp_min(1e-3).log() @ _lever(tail.shape[1])

    def _of_aligned(self, aligned: Tensor, slopes: Tensor, clip: float | None = None) -> Tensor:
        config, limit = self.config, clip or self.config.clip
        linear = torch.cat(
            [
                aligned @ self.segments,
                (aligned - self.mean) @ self.components,
                slopes[:, None],
            ],
            dim=1,
        )
        linear = ((linear - self.centres) / self.spreads).clamp(-limit, limit)
        first = self.segments.shape[1]
        squared = torch.cat([linear[:, first : first + config.squares], linear[:, -1:]], dim=1)
        amplitude = _amplitude(aligned, self.kernel, config.before).clamp_min(1e-4).log()
        distance = (amplitude[:, None] - self.amplitude_centres) / self.amplitude_widths
        density = torch.exp(-0.5 * distance**2)
        return torch.cat([linear, squared**2, density], dim=1).double()


def _names(config: MatchingConfig) -> tuple[str, ...]:
    edges = config.segments
    return (
        *(f"samples {a} to {b}" for a, b in pairwise(edges)),
        *(f"component {i + 1}" for i in range(config.components)),
        "tail slope",
        *(f"component {i + 1} squared" for i in range(config.squares)),
        "tail slope squared",
        *(f"current amplitude, bin {i + 1}" for i in range(config.amplitude_bins)),
    )


def _segments(config: MatchingConfig, length: int) -> Tensor:
    """Means over stretches as a matrix, shape (samples, stretches)."""
    edges = config.segments
    matrix = torch.zeros(length, len(edges) - 1)
    for column, (first, stop) in enumerate(pairwise(edges)):
        matrix[config.before + first : config.before + stop, column] = 1 / (stop - first)
    return matrix


def _amplitude(aligned: Tensor, kernel: Tensor, before: int) -> Tensor:
    """Current amplitude about the half maximum, as `pulses.parameters` defines it."""
    current = torch.diff(aligned, dim=1)
    near = current[:, before - EDGE : before + EDGE]
    half = kernel.shape[1] // 2
    steepest = near.argmax(dim=1) + before - EDGE
    index = steepest[:, None] + torch.arange(-half - EDGE // 3, half + EDGE // 3 + 1)
    around = current.gather(1, index.clamp(0, current.shape[1] - 1))
    phases = nn.functional.conv1d(around[:, None], kernel[:, None])  # (pulses, phases, samples)
    return phases.flatten(1).amax(dim=1)


def _tail_slopes(records: Tensor, preparation: PreparationConfig) -> Tensor:
    """Slopes per sample of the logarithm of the last samples of prepared windows."""
    tail = records[:, -preparation.decay_fit_samples :]
    return tail.clamp_min(1e-3).log() @ _lever(tail.shape[1])


def _lever(samples: int) -> Tensor:
    lever = torch.arange(samples) - 0.5 * (samples - 1)
    return (lever / (lever @ lever)).float()
