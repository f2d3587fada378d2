"""Both sides of a game, and what critics see of them: pulses in units of the data's spread.

Part of the pulses of either side is held out, and critics are judged by it.  Translations get
the noise of the data.  Views are aligned at half maximum.
Everything has gradients, but the whole sample at which a pulse is cut.  Measured and translated
pulses go through the same functions.  A view reaches to the end of the windows, where they are
scaled, and has the current at its own scale: the current amplitude is a peak of a few percent.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, conv1d, pad

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.finishing import padding
from cpunet.pulses.container import Pulses
from cpunet.recipes.schema import ConvolutionalConfig, GruConfig, PreparationConfig

log = logging.getLogger(__name__)

RECENT = 20  # judgements that are averaged
# Part of unseen pairs on which a critic is right that has won; by how much more it is right on
# its own if it knows them by heart; parts of a training before which neither is decided.
WON, HEART, EARLY, HALF = 0.97, 0.1, 0.25, 0.5
BEFORE_NS, END_NS = 3200.0, 64.0  # before the half maximum; left out at the end of a window
BASE_NS, LEVEL_NS = (-3200.0, -1600.0), (4800.0, 5600.0)  # which are scaled to 0 and 1
EDGE_NS = -1792.0, 1280.0
SEGMENT_NS = 400.0
LEAST, LEAST_MEAN = 2e-4, 1e-5  # smallest spread of samples and of means
CURRENT = 15.0  # of the highest currents in the view of an edge
FINE = 0.05  # part of the highest current that a GRU resolves
TOP_NS, SHARP = (16.0, 48.0, 144.0), 60.0  # averages of the current, and of its maxima
BLUR_NS, BLURRED_NS = 48.0, 1000.0  # two equal poles, and the length of their response
BLOCK = 2000  # pulses at a time


class Side(NamedTuple):
    """Pulses of a side (n, samples), their energies in keV, and how many of them are seen."""

    pulses: Tensor
    energy_kev: npt.NDArray[np.float64]
    seen: int

    @classmethod
    def of(cls, pulses: Pulses, held_out: float, seed: int, device: str = "cpu") -> Side:
        """Pulses in random order, of which the last part is held out."""
        order = np.random.default_rng(seed).permutation(len(pulses))
        waveforms = torch.from_numpy(pulses.waveforms[order]).to(device)
        kev = pulses.energy_kev[order].astype(float)
        return cls(waveforms, kev, len(order) - round(held_out * len(order)))

    def draw(self, n: int, *, unseen: bool = False) -> Tensor:
        """Rows of a batch, of the pulses that are seen or of the others."""
        first, stop = (self.seen, len(self.pulses)) if unseen else (0, self.seen)
        return torch.randint(first, stop, (n,))


class Sides(NamedTuple):
    """Simulated and measured pulses, and what is done to translations outside the generators.

    Parameters
    ----------
    sim, data
        Both sides.
    preparation
        Their preparation.
    noise
        Noise of the data; None for none.
    scaled
        Whether translations are scaled as the data are; as published, they are not.
    """

    sim: Side
    data: Side
    preparation: PreparationConfig
    noise: BaselineNoise | None
    scaled: bool

    def noisy(self, pulses: Tensor, rows: Tensor) -> Tensor:
        """Translations of simulated pulses of these rows, with noise as 1/energy."""
        if self.noise is None:
            return pulses
        # seeded by torch, whose random state is part of a checkpoint
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        drawn = self.noise.draw(self.sim.energy_kev[rows.numpy()], pulses.shape[1], rng)
        return pulses + torch.from_numpy(drawn).to(pulses)

    def prepared(self, pulses: Tensor) -> Tensor:
        """Windows of translations, scaled as the data are."""
        c = self.preparation
        if not self.scaled:
            return pulses
        # of records, where they are if nothing is delayed
        room = padding(c.sampled_ns)[0] if pulses.shape[1] > c.length else 0
        window = pulses[:, room : room + c.length]  # (n, samples)
        window = window - window[:, : c.baseline_samples].mean(dim=1, keepdim=True)
        level = window[:, -c.tail_samples :].mean(dim=1, keepdim=True) / c.tail_level
        return window / level.clamp_min(0.1)


class Judge:
    """How often critics are right on pulses that they have not seen, and when a game is over.

    A critic that is right by chance on unseen pulses but not on its own knows these by heart,
    and has nothing to teach; a critic that is nearly always right teaches nothing either, for
    its slope is flat.  By chance on both, a game is where it should be.

    Parameters
    ----------
    sides
        Names of the critics.
    unseen
        Number of pulses of a side that are held out.
    heart
        By how much more a critic that knows its pulses by heart is right on them.  A game that
        begins at a solution is over by chance on unseen pulses: 0.

    Attributes
    ----------
    over
        Critics whose game is over, and how it ended: ``"won"`` or ``"heart"``.
    right
        Part of pairs of the last batch that each critic ordered rightly.
    recent
        The same, and that of unseen pulses, in the last judgements.
    """

    def __init__(self, sides: Sequence[str], unseen: int, heart: float = HEART) -> None:
        self.unseen, self.heart = unseen, heart
        self.over, self.right = dict[str, str](), dict[str, float]()
        self.recent: dict[str, list[tuple[float, float]]] = {side: [] for side in sides}

    def note(self, side: str, right: float, done: float) -> float:
        """Note how often a critic is right, when a part of the training is done; the mean."""
        now = self.right.get(side, 0.5), right
        recent = self.recent[side] = [*self.recent[side], now][-RECENT:]
        own, mean = np.mean(recent, axis=0).tolist()
        if len(recent) < RECENT or side in self.over:
            return float(mean)
        text = f"right on {100 * mean:.0f} % of pulses that it has not seen"
        if mean > WON and done > HALF:
            self.over[side], end = "won", "its game ends here, and the average before counts"
            log.warning(f"the critic of {side} has won: it is {text}; {end}")
        elif mean < 0.5 + 0.5 * self.unseen**-0.5 < own - self.heart and done > EARLY:
            self.over[side], by = "heart", f"and on {100 * own:.0f} % of its own, by heart"
            log.info(f"the critic of {side} is {text}, {by}; its game ends here")
        return float(mean)


def half_sample(pulses: Tensor) -> Tensor:
    """Last sample below half of the maximum before the maximum, shape (n, 1)."""
    with torch.no_grad():
        highest, at = pulses.max(dim=1, keepdim=True)
        index = torch.arange(pulses.shape[1], device=pulses.device)
        below = (pulses < 0.5 * highest) & (index < at)
        return (below * index).amax(dim=1, keepdim=True)


def aligned(pulses: Tensor, config: PreparationConfig) -> Tensor:
    """Pulses at times from their half maximum, with baseline 0 and level 1.

    Parameters
    ----------
    pulses
        Windows or records, shape (n, samples).
    config
        Their preparation.
    """

    def at(first: int, stop: int) -> Tensor:
        index = sample + torch.arange(first, stop, device=pulses.device)
        return pulses.gather(1, index.clamp(0, pulses.shape[1] - 1))

    sample = half_sample(pulses)
    base, level = (
        at(*map(config.samples, part)).mean(dim=1, keepdim=True) for part in (BASE_NS, LEVEL_NS)
    )
    half = 0.5 * (base + level)
    with torch.no_grad():  # noise may cross half of the maximum elsewhere
        near = at(-4, 6)
        crosses = (near[:, :-1] < half) & (near[:, 1:] >= half)
        last = 8 - crosses.flip(1).int().argmax(dim=1, keepdim=True)
        sample = sample - 4 + torch.where(crosses.any(dim=1, keepdim=True), last, 4)
    four = at(-1, 3).unbind(dim=1)
    rise = (four[2] - four[1]).clamp_min(1e-3)
    time = ((half[:, 0] - four[1]) / rise).clamp(-0.5, 1.5)
    for _ in range(2):  # Newton
        value, slope = _cubic(four[0], four[1], four[2], four[3], time)
        time = (time - (value - half[:, 0]) / slope.clamp_min(2e-3)).clamp(-0.5, 1.5)
    first, stop = -config.samples(BEFORE_NS), config.samples(config.after_ns - END_NS)
    x = at(first - 1, stop + 2)
    v, _ = _cubic(x[:, :-3], x[:, 1:-2], x[:, 2:-1], x[:, 3:], time[:, None])
    base, level = (
        v[:, config.samples(part[0]) - first : config.samples(part[1]) - first]
        for part in (BASE_NS, LEVEL_NS)
    )
    zero = base.mean(dim=1, keepdim=True)
    return (v - zero) / (level.mean(dim=1, keepdim=True) - zero).clamp_min(0.1)


def _cubic(a: Tensor, b: Tensor, c: Tensor, d: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Value and slope between `b` and `c` (Catmull-Rom)."""
    rise, bend, skew = 0.5 * (c - a), a - 2.5 * b + 2 * c - 0.5 * d, 0.5 * (3 * (b - c) + d - a)
    return b + t * (rise + t * (bend + t * skew)), rise + t * (2 * bend + 3 * t * skew)


def _soft(values: Tensor) -> Tensor:
    """The same near 0, and logarithms of outliers."""
    return 2 * torch.asinh(values / 2)


class View:
    """Makes views of the pulses of a side, in units of the spread of real ones.

    Parameters
    ----------
    side
        ``"data"`` or ``"sim"``; simulated pulses, whose edges are the sharpest, are blurred.
    real
        Real pulses of this side, shape (n, samples).
    critic
        What reads the views.
    config
        Preparation of the pulses.
    """

    def __init__(
        self,
        side: str,
        real: Tensor,
        critic: ConvolutionalConfig | GruConfig,
        config: PreparationConfig,
    ) -> None:
        self.config, self.critic = config, critic
        self.published = isinstance(critic, GruConfig) and critic.view == "window"
        if self.published:
            return
        lags = torch.arange(1.0, round(BLURRED_NS / config.sampled_ns), device=real.device)
        poles = (lags * torch.exp(-lags * config.sampled_ns / BLUR_NS)).flip(0)
        self.blur = (poles / poles.sum())[None, None] if side == "sim" else None
        v = torch.cat([self.aligned(some) for some in torch.split(real, BLOCK)])
        self.current = v.diff(dim=1).amax(dim=1).median()
        self.scales = []  # medians and robust standard deviations of samples, means and tops
        for values, least in ((v, LEAST), (self.means(v), LEAST_MEAN), (self.tops(v), LEAST)):
            middle = values.median(dim=0).values
            spread = 1.4826 * (values - middle).abs().median(dim=0).values + least
            self.scales.append((middle, spread))
        first, stop = (round((ns + BEFORE_NS) / config.sampled_ns) for ns in EDGE_NS)
        self.n_edge = (stop - first) // 16 * 16
        self.edge = slice(first, first + self.n_edge)
        q = _soft((v - self.scales[0][0]) / self.scales[0][1])
        self.q_mean = q.mean(dim=0)
        some = (q - self.q_mean)[: 3 * BLOCK]
        _, sizes, vectors = torch.linalg.svd(some, full_matrices=False)
        n = min(critic.components, *some.shape)
        self.white = vectors[:n].T / (sizes[:n] / len(some) ** 0.5).clamp_min(1e-4)
        self.size = self(real[:2]).shape[1]

    def aligned(self, pulses: Tensor) -> Tensor:
        """Pulses at times from their half maximum, shape (n, times)."""
        if self.blur is not None:
            edge = pulses[:, None, :1].expand(-1, -1, self.blur.shape[2] - 1)
            pulses = conv1d(torch.cat([edge, pulses[:, None]], dim=2), self.blur)[:, 0]
        return aligned(pulses, self.config)

    def means(self, v: Tensor) -> Tensor:
        """Means of segments, shape (n, segments)."""
        return avg_pool1d(v[:, None], max(1, self.config.samples(SEGMENT_NS)))[:, 0]

    def tops(self, v: Tensor) -> Tensor:
        """Soft maxima of the current, averaged over `TOP_NS`, shape (n, times)."""
        current = v.diff(dim=1)[:, None] / self.current
        widths = (max(1, self.config.samples(ns)) for ns in TOP_NS)
        tops = [avg_pool1d(current, k, 1).mul(SHARP).logsumexp(2) / SHARP for k in widths]
        return torch.cat(tops, dim=1)

    def __call__(self, pulses: Tensor) -> Tensor:
        """What the critic reads of windows or records (n, samples); shape (n, numbers)."""
        if self.published:
            return pulses
        (middle, spread), (mean, of_mean), (top, of_top) = self.scales
        v = self.aligned(pulses)
        q, current = (v - middle) / spread, pad(v.diff(dim=1), (1, 0)) / self.current
        components = ((_soft(q) - self.q_mean) @ self.white).clamp(-8, 8)
        if isinstance(self.critic, GruConfig):  # in turn, within the 0 … 1 of its table
            begin = v.shape[1] % self.critic.samples_per_step  # where a pulse is flat
            fine = torch.asinh((current - 1) / FINE) / 8
            pairs = torch.stack([torch.asinh(q / 2) / 6, fine], dim=2)[:, begin:].flatten(1)
            tops = _soft((self.tops(v) - top) / of_top).clamp(-8, 8)
            whole = torch.cat([pairs, components / 16, tops / 16], dim=1) + 0.5
            return pad(whole, (0, -whole.shape[1] % self.critic.samples_per_step))
        means = _soft((self.means(v) - mean) / of_mean)
        edge = _soft(q[:, self.edge]), CURRENT * (current[:, self.edge] - 0.5)
        return torch.cat([*edge, means, components], dim=1)
