"""Time of a CycleGAN training step: a plain implementation of the paper, and ours.

Run with ``python benchmarks/training_step.py --recipe paper``.  The plain step is eager float32
PyTorch on the same networks: six passes one by one, a loop over pulses in each L1 loss, and
each loss fetched as a number.  Each variant runs in a process of its own; they take turns, so
that other load on the machine affects all of them, and medians are compared.  No step updates
the discriminators, which recipe `paper` does in one step of 30.

``--steps ours bf16 compiled bf16-compiled`` compares our step as in the recipe with bf16 and
torch.compile, and ``--device cuda`` does so on a GPU.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from cpunet.jobs.common.memory import keep_freed_memory
from cpunet.networks.positional_unet import positional_map
from cpunet.recipes import load_recipe
from cpunet.recipes.schema import Recipe
from cpunet.training.cyclegan import CycleGan, Step

CONVOLUTIONS = (
    "aten::convolution",
    "aten::convolution_backward",
    "_Convolution",
    "_ConvolutionBackward",
)


class PlainUNet(nn.Module):
    """Section 2.2.1, layer by layer."""

    def __init__(self, m: int, length: int, dropout: float) -> None:
        super().__init__()

        def block(inside: int, outside: int, mid: int) -> nn.Sequential:
            return nn.Sequential(
                nn.Conv1d(inside, mid, 11, padding=5, bias=False),
                nn.BatchNorm1d(mid),
                nn.LeakyReLU(0.01),
                nn.Conv1d(mid, outside, 7, padding=3, bias=False),
                nn.BatchNorm1d(outside),
                nn.LeakyReLU(0.01),
            )

        widths = (1, m, 2 * m, 4 * m, 8 * m, 8 * m)
        self.down = nn.ModuleList(block(a, b, b) for a, b in itertools.pairwise(widths))
        self.mean = nn.Conv1d(8 * m, 8 * m, 1)
        self.log_variance = nn.Conv1d(8 * m, 8 * m, 1)
        self.up = nn.ModuleList(
            block(2 * c, o, c)
            for c, o in ((8 * m, 4 * m), (4 * m, 2 * m), (2 * m, m), (m, m // 2))
        )
        self.outlet = nn.Conv1d(m // 2, 1, 1)
        self.dropout = nn.Dropout(dropout)
        levels = ((m, 1, 0), (2 * m, 2, 0), (4 * m, 4, 0), (8 * m, 8, 0), (8 * m, 16, 0))
        levels += ((4 * m, 8, 4 * m), (2 * m, 4, 2 * m), (m, 2, 2 * m))
        for number, (channels, factor, offset) in enumerate(levels):
            values = positional_map(channels, length // factor, offset)
            self.register_buffer(f"map{number}", values)

    def forward(self, x: Tensor) -> Tensor:
        skips = []
        for level, block in enumerate(self.down):
            x = block(functional.max_pool1d(x, 2) if level else x)
            if level < 4:
                x = self.dropout(x + getattr(self, f"map{level}"))
                skips.append(x)
        mean, log_variance = self.mean(x), self.log_variance(x)
        x = mean + torch.exp(log_variance / 2) * torch.randn_like(mean)
        x = self.dropout(x + self.map4)
        for level, block in enumerate(self.up):
            x = functional.interpolate(x, scale_factor=2, mode="linear", align_corners=True)
            x = block(torch.cat([skips[3 - level], x], dim=1))
            if level < 3:
                x = self.dropout(x + getattr(self, f"map{5 + level}"))
        return self.outlet(x)


class PlainJudge(nn.Module):
    """Section 2.2.2, with interpolation between the rows of the table."""

    def __init__(self, rows: int, dim: int, hidden: int) -> None:
        super().__init__()
        self.table = nn.Embedding(rows, dim)
        self.gru = nn.GRU(dim, hidden, batch_first=True, bidirectional=True)
        self.attention = nn.Linear(2 * hidden, 2 * hidden, bias=False)
        self.norm = nn.BatchNorm1d(2 * hidden)
        self.outlet = nn.Linear(4 * hidden, 1)

    def forward(self, pulses: Tensor) -> Tensor:
        x = pulses[:, 0]
        low, high = x.min(1, keepdim=True).values, x.max(1, keepdim=True).values
        code = (x - low) / (high - low) * (self.table.num_embeddings - 1)
        lower = code.detach().floor().clamp(max=self.table.num_embeddings - 2)
        part = (code - lower).unsqueeze(-1)
        index = lower.long()
        vectors = self.table(index) * (1 - part) + self.table(index + 1) * part
        outputs, final = self.gru(vectors)
        final = torch.cat([final[0], final[1]], dim=1)
        query = self.attention(final).unsqueeze(2) / final.shape[1] ** 0.5
        context = (torch.softmax(outputs @ query, dim=1) * outputs).sum(1)
        return torch.sigmoid(self.outlet(torch.cat([self.norm(context), final], 1)))[:, 0]


def plain_step(recipe: Recipe, sim: Tensor, data: Tensor) -> Callable[[], object]:
    """The generators' update, as a reader of the paper would write it."""
    generator, judge, training = recipe.cyclegan
    length, losses = recipe.preparation.length, training.losses
    ren, iren = (PlainUNet(generator.width, length, generator.dropout) for _ in range(2))
    judges = [
        PlainJudge(judge.embedding_rows, judge.embedding_dim, judge.hidden) for _ in range(2)
    ]
    for network in judges:
        network.requires_grad_(False)
        network.norm.eval()
    parameters = [*ren.parameters(), *iren.parameters()]
    optimiser = torch.optim.AdamW(parameters, training.rate_generators, training.betas)
    first = losses.baseline_len
    second = first + losses.rising_edge_len

    def l1(found: Tensor, wanted: Tensor) -> Tensor:
        total = torch.zeros(())
        for a, b in zip(found, wanted, strict=True):
            difference = (a - b).abs()[0]
            total = total + losses.baseline_weight * difference[:first].mean()
            total = total + losses.rising_edge_weight * difference[first:second].mean()
            total = total + losses.tail_weight * difference[second:].mean()
        return total / len(found)

    def step() -> list[float]:
        fake_data, fake_sim = ren(sim), iren(data)
        real = torch.ones(len(sim))
        parts = [
            losses.identity_weight * l1(ren(data), data),
            losses.identity_weight * l1(iren(sim), sim),
            losses.cycle_weight * l1(iren(fake_data), sim),
            losses.cycle_weight * l1(ren(fake_sim), data),
            losses.adversarial_weight
            * functional.binary_cross_entropy(judges[0](fake_data), real),
            losses.adversarial_weight
            * functional.binary_cross_entropy(judges[1](fake_sim), real),
        ]
        optimiser.zero_grad()
        sum(parts).backward()
        nn.utils.clip_grad_norm_(parameters, training.max_grad_norm)
        optimiser.step()
        return [part.item() for part in parts]

    return step


def our_step(recipe: Recipe, sim: Tensor, data: Tensor) -> Callable[[], object]:
    keep_freed_memory()
    model = CycleGan(recipe).to(sim.device).train()
    step = Step(model, recipe.cyclegan.training)
    return lambda: step._update_generators(sim, data, None)


OURS: dict[str, list[str]] = {
    "ours": [],
    "bf16": ["training.precision=bf16"],
    "compiled": ["training.compiled=true"],
    "bf16-compiled": ["training.precision=bf16", "training.compiled=true"],
}


def wait(device: str) -> None:
    """Wait until a GPU has finished its work."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def work(name: str, recipe_name: str, threads: int, device: str, line: Connection) -> None:
    """Execute the orders on a connection: "step", "share", "flop" or "end"."""
    torch.set_num_threads(threads)
    torch.set_default_device(device)
    torch.manual_seed(0)
    recipe = load_recipe(recipe_name, OURS.get(name, []))
    batch, length = recipe.cyclegan.training.batch_size, recipe.preparation.length
    rng = np.random.default_rng(0)
    ramps = (np.arange(length) - length / 2) / rng.uniform(20, 90, (2, batch, 1, 1)) + 1
    sim, data = torch.from_numpy(np.clip(ramps, 0, 1).astype(np.float32)).to(device)
    step = (our_step if name in OURS else plain_step)(recipe, sim, data)
    for _ in range(3 if device != "cpu" or "compiled" in name else 1):
        step()
    while (order := line.recv()) != "end":
        if order == "flop":
            with FlopCounterMode(display=False) as counter:
                step()
            line.send(counter.get_total_flops() / 1e9)
            continue
        begin = time.perf_counter()
        if order == "share":
            with profile(activities=[ProfilerActivity.CPU]) as told:
                step()
                wait(device)
            events = {event.key: event for event in told.key_averages()}
            everything = sum(event.self_cpu_time_total for event in events.values())
            inside = sum(events[k].cpu_time_total for k in CONVOLUTIONS if k in events)
            line.send(inside / everything)
        else:
            step()
            wait(device)
            line.send(time.perf_counter() - begin)
    if device.startswith("cuda"):
        line.send(torch.cuda.max_memory_allocated() / 2**30)
        return
    unit = 2**30 if sys.platform == "darwin" else 2**20
    line.send(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)


def gemm_rate(device: str) -> float:
    """GFLOP/s of a large matrix product."""
    a = torch.randn(2048, 2048, device=device)
    times = []
    for _ in range(5):
        wait(device)
        begin = time.perf_counter()
        a @ a
        wait(device)
        times.append(time.perf_counter() - begin)
    return 2 * 2048**3 / float(np.median(times)) / 1e9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recipe", default="paper")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", nargs="+", choices=list(OURS), default=["ours"])
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    context = multiprocessing.get_context("spawn")
    lines: dict[str, Connection] = {}
    for name in ("plain", *given.steps):
        lines[name], far = context.Pipe()
        arguments = (name, given.recipe, given.threads, given.device, far)
        context.Process(target=work, args=arguments, daemon=True).start()

    def ask(name: str, order: str) -> float:
        lines[name].send(order)
        return lines[name].recv()

    flop = ask("plain", "flop")
    times: dict[str, list[float]] = {name: [] for name in lines}
    rates = []
    for _ in range(given.repeats):
        rates.append(gemm_rate(given.device))
        for name in lines:
            times[name].append(ask(name, "step"))
        print("  ".join(f"{name} {v[-1]:.3g} s" for name, v in times.items()), flush=True)
    # convolutions cannot be identified in compiled kernels, and time on a GPU is not profiled
    told = {n: ask(n, "share") for n in lines if given.device == "cpu" and "compiled" not in n}
    memory = {name: ask(name, "end") for name in lines}
    rate = float(np.median(rates))
    print(f"recipe {given.recipe}, {given.device}, {given.threads} thread(s)")
    print(
        f"{'step':<14}{'s':>8}{'convolutions':>14}{'peak GB':>9}{'times as fast (turns)':>28}"
    )
    plain = np.array(times["plain"])
    for name, seconds in times.items():
        share = f"{told[name]:.0%}" if name in told else "-"
        ratios = plain / seconds
        ratio = np.median(plain) / np.median(seconds)
        print(
            f"{name:<14}{np.median(seconds):>8.3g}{share:>14}{memory[name]:>9.2f}"
            f"{f'{ratio:.2f} ({ratios.min():.2f} to {ratios.max():.2f})':>28}"
        )
    print(
        f"plain arithmetic {flop:.0f} GFLOP; matrix products run at {rate:.0f} GFLOP/s: "
        f"at least {flop / rate:.2g} s without fast convolutions"
    )


if __name__ == "__main__":
    main()
