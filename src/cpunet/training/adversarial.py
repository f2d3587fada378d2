"""CPU-Net's CycleGAN: two generators against two critics, unpaired (paper, section 3.4).

::

    REN    x (simulated) ─▶ K x + U(K x)         IREN   y (measured) ─▶ K' y + U'(K' y)
    critic of the data         y  against  REN(x) + noise
    critic of the simulation   x + K'(noise)  against  IREN(y)
    cycles                     IREN(REN(x) + noise) = x     REN(IREN(y)) = y
    identities                 REN(y) = y                   IREN(x) = x

K is linear, solved or learned (`cpunet.networks.linear_parts`), by the critic of the data
alone; U, a Positional U-Net, adds nothing at first.  As published, U is all.  Read from the
top: generators, critic, losses, an iteration, the loop.  Critics see views of pulses
(`cpunet.training.views`).
"""

from __future__ import annotations

import copy
import logging
import math
import signal
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad, softplus
from torch.nn.utils import clip_grad_norm_
from torch.optim import AdamW

from cpunet.errors import CpunetError
from cpunet.networks.positional_unet import GruDiscriminator, PositionalUNet
from cpunet.recipes import schema
from cpunet.training.run import Record
from cpunet.training.unfinished import State, waiting_signals
from cpunet.training.views import HEART, WON, Judge, Sides, View, half_sample

log = logging.getLogger(__name__)

SIZE, FAST_NS, AROUND_NS = 0.1, 128.0, 2048.0  # of a change by U, its current, and its stretch
SLOPE, SHARP, TOP = 0.2, 4.0, 6.0  # of the critic
TOLERATED = 3.0  # deviation of a cycle that is ignored, in RMS of the pulse's own baseline
SOME, PROBE, LAZY = 4000, 0.01, 4  # pulses of a view; step, and interval, of a GRU's penalty
JUDGED = 5  # iterations between judgements of critics


class Residual(nn.Module):
    """What a Positional U-Net adds to a pulse about its half maximum, wherever that is."""

    def __init__(self, config: schema.PunetConfig, dt_ns: float) -> None:
        super().__init__()
        self.around, self.scale = 8 * round(AROUND_NS / dt_ns / 8), FAST_NS / dt_ns
        self.unet = PositionalUNet(config, 2 * self.around, residual=True)

    def forward(self, pulses: Tensor) -> Tensor:
        """Change of pulses of any height, of the same shape (n, samples)."""
        at, n = half_sample(pulses) - self.around, 2 * self.around
        index = at + torch.arange(-1, n, device=at.device)  # (n, 2 around + 1)
        height = pulses.detach().amax(dim=1, keepdim=True).clamp_min(0.1)
        x = pulses.gather(1, index.clamp(0, pulses.shape[1] - 1)) / height
        seen = torch.stack([2 * x[:, 1:] - 1, self.scale * x.diff(dim=1)], dim=1)
        change: Tensor = pad(SIZE * self.unet(seen)[:, 0], (1, 0)) * height  # begins with 0
        since = torch.arange(1, 1 + pulses.shape[1], device=at.device) - at
        return change.gather(1, since.clamp(0, n))


class Generator(nn.Module):
    """A linear part, and what a U-Net adds to its pulses; or a U-Net alone, as published."""

    linear: nn.Module | None

    def __init__(self, unet: nn.Module, linear: nn.Module | None = None) -> None:
        super().__init__()
        self.unet, self.linear = unet, linear

    def forward(self, pulses: Tensor) -> Tensor:
        """Translations of windows (n, samples): windows, or records with room around them."""
        if self.linear is None:
            out: Tensor = self.unet(pulses[:, None], mean=not self.training)
            return out[:, 0]
        pulses = self.linear(pulses)
        return pulses + self.change(pulses)

    def change(self, pulses: Tensor) -> Tensor:
        """What is done to pulses that are in the generator's range already."""
        made: Tensor = self(pulses) - pulses if self.linear is None else self.unet(pulses)
        return made


class Critic(nn.Module):
    """Rates views of edges: convolutions, soft maxima of the current, and single numbers."""

    def __init__(self, config: schema.ConvolutionalConfig, n_edge: int, n_view: int) -> None:
        super().__init__()
        c, h, act = config.channels, config.hidden, nn.LeakyReLU(SLOPE)
        layers: list[nn.Module] = []
        for i, o, k in ((2, c, 9), (c, 2 * c, 7), (2 * c, 2 * c, 5), (2 * c, c, 5)):
            layers += [nn.Conv1d(i, o, k, stride=2, padding=k // 2), act]
        self.n, flat = n_edge, c * n_edge // 16
        self.edge = nn.Sequential(*layers, nn.Flatten(), nn.Linear(flat, h))
        self.numbers = nn.Sequential(nn.Linear(n_view - 2 * n_edge, h), act, nn.Linear(h, h))
        self.top, self.tops = nn.Conv1d(1, 8, 9, bias=False), nn.Linear(8, h)
        self.top.weight.data = 1 / 9 + 0.05 * torch.randn_like(self.top.weight)
        self.out = nn.Sequential(act, nn.Linear(h, h), act, nn.Linear(h, 1))

    def forward(self, views: Tensor) -> Tensor:
        """Logits, shape (n,), of views (n, numbers); higher for real ones."""
        charge, current, numbers = views.tensor_split([self.n, 2 * self.n], dim=1)
        edge = torch.stack([charge, current / 4], dim=1)  # (n, 2, samples)
        top = torch.logsumexp(SHARP * self.top(current[:, None]), dim=2) / SHARP - TOP  # (n, 8)
        joined = self.edge(edge) + self.numbers(numbers) + self.tops(top)
        return self.out(joined)[:, 0]  # type: ignore[no-any-return]


def window_weights(config: schema.LossConfig, length: int) -> Tensor:
    """Weight of each sample in the L1 losses: baseline, edge and tail count by their means."""
    begin = config.samples(config.baseline_ns)
    end = config.samples(config.baseline_ns + config.rising_edge_ns)
    each = config.baseline_weight, config.rising_edge_weight, config.tail_weight
    lengths = begin, end - begin, length - end
    return torch.cat([torch.full((n,), w / n) for n, w in zip(lengths, each, strict=True)])


def weighted_l1(difference: Tensor, weights: Tensor, ignored: Tensor | float = 0.0) -> Tensor:
    r"""Weighted L1 loss :math:`\langle \sum_k w_k \max(|d_k| - g, 0) \rangle`."""
    return ((difference.abs() - ignored).clamp_min(0) * weights).sum(dim=1).mean()


def adversarial_loss(better: Tensor, worse: Tensor, paired: bool) -> Tensor:
    r"""Loss of logits `better`, :math:`b`, which should be higher than `worse`, :math:`w`.

    Paired, :math:`\langle \ln(1 + e^{w - b}) \rangle` (arXiv:2501.05441); else the published
    cross-entropy :math:`\langle \ln(1 + e^{-b}) + \ln(1 + e^w) \rangle`.
    """
    terms = softplus(worse - better) if paired else softplus(-better) + softplus(worse)
    return terms.mean()


def slopes_squared(critic: nn.Module, views: Tensor) -> Tensor:
    """Zero-centred penalty: the mean squared gradient, of a GRU in a random direction."""
    if isinstance(critic, GruDiscriminator):  # whose second derivatives are slow
        moved = critic(views + PROBE * torch.randn_like(views))
        along: Tensor = (moved - critic(views)) / PROBE
        return along.square().mean()
    views = views.detach().requires_grad_()
    (slope,) = torch.autograd.grad(critic(views).sum(), views, create_graph=True)
    squares: Tensor = slope.square().sum(dim=1).mean()
    return squares


class Game:
    """Generators, critics of both sides, and an iteration of their training."""

    def __init__(
        self, ren: Generator, iren: Generator, sides: Sides, settings: schema.CycleGanConfig
    ) -> None:
        self.ren, self.iren, self.sides, self.config = ren, iren, sides, settings.training
        c, critic, device = settings.training, settings.discriminator, sides.data.pulses.device
        own, gru = sides.preparation, isinstance(critic, schema.GruConfig)
        self.weights = window_weights(c.losses, own.length).to(device)
        some = self.with_noise(sides.sim.draw(min(SOME, 4 * sides.sim.seen)))
        real = {"data": sides.data.pulses[: sides.data.seen], "sim": some}
        with torch.no_grad():
            self.views = {side: View(side, those, critic, own) for side, those in real.items()}
        critics = {
            side: GruDiscriminator(critic)
            if isinstance(critic, schema.GruConfig)
            else Critic(critic, view.n_edge, view.size)
            for side, view in self.views.items()
        }
        self.critics = nn.ModuleDict(critics).to(device)
        self.generators = nn.ModuleDict({"ren": ren, "iren": iren}).to(device).train()
        self.average = copy.deepcopy(self.generators).requires_grad_(False)
        self.good = copy.deepcopy(self.average)  # when the critic of the data had not won
        how: Any = {"betas": c.betas, "weight_decay": c.weight_decay}
        named, own_rate = [*self.generators.named_parameters()], c.rate_discriminators
        groups = [
            {"params": [p for name, p in named if part in name], "rate": rate}
            for part, rate in ((".unet.", c.rate_generators), (".linear.", c.rate_linear))
        ]
        self.optimisers = {"pair": AdamW(groups, **how)} | {
            side: AdamW([{"params": [*network.parameters()], "rate": own_rate}], **how)
            for side, network in self.critics.items()
        }
        unseen = min(len(side.pulses) - side.seen for side in sides[:2])
        solved = ren.linear is not None and not [*ren.linear.parameters()]
        self.judge = Judge([*real], unseen, 0.0 if solved else HEART)
        self.lazy = LAZY if gru else 1
        self.iteration = 0
        names = "generators", "critics", "average", "good"
        self.parts: dict[str, Any] = {name: getattr(self, name) for name in names}
        self.parts |= self.optimisers  # which a state is of

    def state(self) -> State:
        """All that the next iterations depend on, except pulses and settings."""
        return {
            "iteration": self.iteration,
            "judge": copy.deepcopy(vars(self.judge)),
            "random": [torch.get_rng_state(), *torch.cuda.get_rng_state_all()],
            "parts": {name: part.state_dict() for name, part in self.parts.items()},
        }

    def restore(self, state: State) -> None:
        """Continue from a state of the same pulses and settings."""
        self.iteration = state["iteration"]
        vars(self.judge).update(copy.deepcopy(state["judge"]))
        for name, part in self.parts.items():
            part.load_state_dict(state["parts"][name])
        torch.set_rng_state(state["random"][0])
        if torch.cuda.is_available():
            torch.cuda.set_rng_state_all(state["random"][1:])

    @torch.no_grad()
    def with_noise(self, rows: Tensor) -> Tensor:
        """Simulated pulses, with the noise that IREN's linear part leaves."""
        x, k, inverse = self.sides.sim.pulses[rows], self.ren.linear, self.iren.linear
        if self.sides.noise is None or k is None or inverse is None:
            return x
        clean, noisy = (self.sides.prepared(p) for p in (k(x), self.sides.noisy(k(x), rows)))
        noise: Tensor = inverse(noisy) - inverse(clean)
        return x + noise

    def step(self) -> dict[str, float]:
        """An iteration; its losses."""
        c, sim, data, ren, iren = *(self.config, *self.sides[:2]), self.ren, self.iren
        rows, y, losses = sim.draw(c.batch_size), data.draw(c.batch_size), dict[str, Tensor]()
        y, w, prepared = data.pulses[y], self.weights, self.sides.prepared
        full = self.iteration % c.cycle_interval == 0
        rise = (self.iteration + 1) / max(1, c.warmup)
        left = min(1.0, (c.iterations - self.iteration) / max(1, c.iterations - c.decay_start))
        for name, optimiser in self.optimisers.items():
            fall = max(left**c.decay_power, c.least_rate if name in self.critics else 0.0)
            for group in optimiser.param_groups:
                group["lr"] = group["rate"] * min(1.0, rise, fall)
        if full or "data" not in self.judge.over:
            fake = self.sides.noisy(ren(sim.pulses[rows]), rows)  # (n, samples with room)
            losses |= self.play("data", "ren", y, fake)
        if full:
            rows, y, fake = rows[: c.cycle_size], y[: c.cycle_size], fake[: c.cycle_size]
            x, back = sim.pulses[rows], iren(y)
            losses |= self.play("sim", "iren", self.with_noise(rows), back)
            # Its inverse is smooth, for which cycles would make a linear part too sharp.
            fixed = ren if "data" in self.judge.over else ren.linear
            if fixed is not None and [*fixed.parameters()]:
                fixed.requires_grad_(False)
                fake = self.sides.noisy(ren(x), rows)
            rms = y[:, : self.sides.preparation.baseline_samples].std(dim=1, keepdim=True)
            noise = TOLERATED * rms * (self.sides.noise is not None)  # no generator makes it
            losses["cycle_forward"] = weighted_l1(iren(prepared(fake)) - x, w)
            losses["cycle_backward"] = weighted_l1(prepared(ren(back)) - y, w, noise)
            losses["identity_data"] = weighted_l1(ren.change(y), w)
            losses["identity_sim"] = weighted_l1(iren.change(x), w)
            ren.requires_grad_(True)
        if losses:
            kinds = ((name.partition("_")[0], loss) for name, loss in losses.items())
            weight = c.losses.model_dump()
            total = sum(weight[f"{k}_weight"] * a for k, a in kinds if k != "discriminator")
            self.follow(total, "pair")
            keep = min(c.average, (1 + self.iteration) / (10 + self.iteration))
            own, averages = (net.state_dict() for net in (self.generators, self.average))
            for name, value in averages.items():
                new = own[name]
                value.copy_(new.lerp(value, keep) if value.is_floating_point() else new)
        self.iteration += 1
        return {name: float(loss.detach()) for name, loss in losses.items()}

    def play(self, side: str, part: str, real: Tensor, fake: Tensor) -> dict[str, Tensor]:
        """Train the critic of a side; its loss, and that of the generator by it."""
        if side in self.judge.over:
            return {}
        c, critic, losses = self.config, self.critics[side].requires_grad_(True).train(), {}
        of_real, of_fake = self.views[side](real), self.views[side](fake)
        if self.iteration % c.discriminator_interval == 0:
            both = torch.cat([of_real, of_fake.detach()])  # a batch norm must see both together
            better, worse = critic(both).chunk(2)
            losses[f"discriminator_{side}"] = loss = adversarial_loss(better, worse, c.paired)
            if c.penalty and self.iteration % self.lazy == 0:
                loss = loss + self.lazy * c.penalty * slopes_squared(critic, both)
            self.follow(loss, side)
            self.judge.right[side] = float((better > worse).float().mean())
        critic.requires_grad_(False)
        if isinstance(critic, GruDiscriminator):
            critic.norm.eval()  # not the GRU: cuDNN's has no backward pass in evaluation
        judged, by = critic(of_fake), critic(of_real).detach()
        losses[f"adversarial_{part}"] = adversarial_loss(judged, by, c.paired)
        return losses

    def follow(self, loss: Any, name: str) -> None:
        """Move a critic, or the pair of generators, down the slope of a loss."""
        optimiser = self.optimisers[name]
        optimiser.zero_grad()
        loss.backward()
        for group in optimiser.param_groups:
            clip_grad_norm_(group["params"], self.config.max_grad_norm)
        optimiser.step()

    @torch.no_grad()
    def judged(self) -> dict[str, float]:
        """Part of pairs that critics order rightly: of the training, and of unseen pulses."""
        results, n = dict(self.judge.right), self.config.batch_size
        if not self.judge.unseen:
            return results
        rows, others = (side.draw(n, unseen=True) for side in self.sides[:2])
        x, y = self.sides.sim.pulses[rows], self.sides.data.pulses[others]
        pairs = {
            "data": (y, self.sides.noisy(self.ren(x), rows)),
            "sim": (self.with_noise(rows), self.iren(y)),
        }
        for side, pair in pairs.items():
            real, fake = (self.critics[side](self.views[side](pulses)) for pulses in pair)
            results[f"{side}_unseen"] = right = float((real > fake).float().mean())
            mean = self.judge.note(side, right, self.iteration / self.config.iterations)
            if side == "data" and mean <= WON:
                self.good.load_state_dict(self.average.state_dict())
        return results


def train(
    make: Callable[[], Game],
    seed: int,
    *,
    listener: Callable[[list[Record]], None] = lambda _: None,
    save: Callable[[State], None] = lambda _: None,
    start: State | None = None,
) -> Game:
    """Play a game to its end, from a state if given; its average is what counts.

    The same seed on the same computer gives the same weights, interrupted or not.  Records are
    listened to before each state is saved: every ``checkpoint_interval`` iterations, in the end
    and at Ctrl-C or SIGTERM, which act between iterations.  A loss or weight that is not finite
    is a `CpunetError`.
    """
    with torch.random.fork_rng(), waiting_signals() as waiting:
        torch.manual_seed(seed)
        game, records = make(), list[Record]()
        if start is not None:
            game.restore(start)
        c = game.config
        over = game.judge.over
        while game.iteration < c.iterations and over.get("data") != "won" and len(over) < 2:
            losses, done = game.step(), game.iteration
            rate = game.optimisers["pair"].param_groups[0]["lr"]
            records.append({"iteration": done - 1, "rate": rate, "losses": losses})
            stop = bool(waiting) and done < c.iterations
            keep = stop or done == c.iterations or done % c.checkpoint_interval == 0
            if done % JUDGED == 0:
                records[-1]["accuracy"] = game.judged()
            of_weights = [float(p.sum()) for p in game.average.parameters()] if keep else []
            if not all(map(math.isfinite, (*losses.values(), *of_weights))):
                text = f"a loss or weight is not finite in iteration {done - 1} (seed {seed})"
                remedy = "lower the learning rates or change the seed, and begin again"
                raise CpunetError(f"training diverged: {text}", remedy)
            if keep or done % c.log_interval == 0:
                listener(records)
                records = []
            if keep:
                save(game.state())
            if stop:
                text = f"stopped after {done} of {c.iterations} iterations"
                log.info(f"{text}; resume goes on from it")
                signal.raise_signal(waiting[0])
        if records:
            listener(records)
    if game.judge.over.get("data") == "won":
        game.average.load_state_dict(game.good.state_dict())
    game.average.eval()
    return game
