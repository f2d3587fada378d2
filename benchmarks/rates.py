"""Pulses per second on one core: preparation, parameters, translation.

Run with ``python benchmarks/rates.py``; takes a minute.  Each rate is the median of a few runs.
Preparation and parameters are compared with plain loops in NumPy that go pulse by pulse, as a
reader of the paper would write them, and parameters with dspeed's processors on whole pulses;
translations with the U-Net of recipe `paper`.  The floor is the time to copy all pulses once.
``--threads 2`` is for translations; on a GPU (``--device cuda``), ``--pulses 4096`` keeps it
busy.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt
from dspeed.processors import (
    avg_current,
    interpolated_time_point_thresh,
    min_max,
    moving_window_multi,
    upsampler,
)

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.kernels import use_threads
from cpunet.networks.generators import ResponseGenerator
from cpunet.networks.positional_unet import PositionalUNet
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import pulse_parameters
from cpunet.pulses.preparation import prepare
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.recipes import load_recipe
from cpunet.training.adversarial import Generator
from cpunet.translation.backends import Batch, NetworkBackend, ResponseBackend

TRACES, PULSES, RAMPS, PLAIN, REPEATS = 10_000, 20_000, 8192, 500, 5
DT_NS, FEP_KEV, TAIL = 16.0, 2614.5, 300
SMALL = 4000  # pulses of the slower calculations


def rate(work: Callable[[], object], n: int) -> float:
    """Pulses per second, the median of a few runs."""
    work()  # compiles, or loads what was compiled before
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return n / float(np.median(times))


def show(title: str, rates: dict[str, float], reference: str) -> None:
    """Print rates, and their ratios to that of a reference."""
    print(f"{title:<34}{'pulses/s':>10}{'ratio':>8}")
    for name, value in rates.items():
        print(f"  {name:<32}{value:>10,.0f}{value / rates[reference]:>8.1f}")


def adc_traces() -> npt.NDArray[np.uint16]:
    """Raw traces of 1,200 samples."""
    rng = np.random.default_rng(0)
    t = np.maximum(np.arange(1200) - rng.uniform(540, 580, (TRACES, 1)), 0)
    shape = (1 - np.exp(-((t / 25) ** 2))) * np.exp(-t / 3750)
    return np.asarray(14_000 + 20_000 * shape + rng.normal(0, 10, t.shape), np.uint16)


def prepared_plainly(waveforms: FloatArray) -> None:
    """Align, cut, scale and fit the tail, trace by trace in NumPy."""
    for trace in waveforms:
        base = trace[:200].mean(dtype=float)
        top = int(trace.argmax())
        below = np.flatnonzero(trace[:top] < base + 0.999 * (trace[top] - base))
        align = int(below[-1]) + 1
        window = trace[align - 400 : align + 400].astype(float)
        window -= window[:200].mean()
        window *= 0.80 / window[-5:].mean()
        np.polyfit(np.arange(TAIL), np.log(window[-TAIL:]), 1)


def prepared() -> FloatArray:
    """Pulses of 800 samples with a decay and noise of 0.1 %."""
    rng = np.random.default_rng(0)
    after = np.arange(800) - rng.uniform(340, 380, (PULSES, 1))
    edge = 1 / (1 + np.exp(-after / rng.uniform(4, 12, (PULSES, 1))))
    pulses = edge * np.exp(-np.maximum(after, 0) / 3400)
    return (pulses + rng.normal(0, 1e-3, pulses.shape)).astype(np.float32)


def parameters_of_dspeed(waveforms: FloatArray) -> None:
    """Compute the three parameters of the paper with dspeed's processors, block by block."""
    for first in range(0, len(waveforms), 256):
        block = waveforms[first : first + 256]
        current = np.empty((len(block), 799), np.float32)
        avg_current(block, 1, current)
        fine = np.empty((len(block), 798 * 16), np.float32)
        upsampler(current, 16, fine)
        smooth = np.empty_like(fine)
        moving_window_multi(fine, 48, 3, 0, smooth)
        min_max(smooth)
        _, end, _, height = min_max(block)
        interpolated_time_point_thresh(block, 0.01 * height, end.astype(int), 0, ord("l"))
        np.polyfit(np.arange(TAIL), np.log(block[:, -TAIL:]).T, 1)


def parameters_plainly(waveforms: FloatArray) -> None:
    """The same, pulse by pulse in NumPy."""
    box, fine = np.ones(48) / 48, np.arange(0, 799, 1 / 16)
    for pulse in waveforms:
        current = np.interp(fine, np.arange(799), np.diff(pulse))
        for _ in range(3):
            current = np.convolve(current, box, "same")
        current.max()
        top = int(pulse.argmax())
        below = int(np.flatnonzero(pulse[:top] < 0.01 * pulse[top])[-1])
        np.interp(0.01 * pulse[top], pulse[below : below + 2], [below, below + 1])
        np.polyfit(np.arange(TAIL), np.log(pulse[-TAIL:]), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--pulses", type=int, default=32, help="of a batch of the large U-Net")
    given = parser.parse_args()
    use_threads(1)

    adc, config = adc_traces(), load_recipe("published").preparation
    traces = adc.astype(np.float32)
    raw = Pulses.of(traces, dt_ns=DT_NS)
    rates = {
        "compiled": rate(lambda: prepare(raw, config, "measured"), TRACES),
        "plain loop in NumPy": rate(lambda: prepared_plainly(traces[:PLAIN]), PLAIN),
        "floor: uint16 to float32": rate(lambda: adc.astype(np.float32), TRACES),
    }
    show("preparation", rates, "plain loop in NumPy")

    fast, waveforms = load_recipe("fast").at(DT_NS), prepared()
    pulses = Pulses.of(waveforms, dt_ns=DT_NS)
    settings, some = (fast.preparation, fast.scores), waveforms[:SMALL]
    rates = {
        "three": rate(lambda: pulse_parameters(pulses, *settings), PULSES),
        "three, dspeed on whole pulses": rate(lambda: parameters_of_dspeed(some), SMALL),
        "three, plain loop in NumPy": rate(lambda: parameters_plainly(some[:PLAIN]), PLAIN),
        "all": rate(lambda: all_parameters(pulses[:SMALL], *settings), SMALL),
        "floor: pulses copied": rate(waveforms.copy, PULSES),
    }
    show("parameters", rates, "three, plain loop in NumPy")

    use_threads(given.threads)
    chain = ResponseGenerator(fast.matching.generator, DT_NS)
    chain.set_noise(BaselineNoise(np.ones(4097), 8192, DT_NS, 100))
    response = ResponseBackend(chain, fast.preparation, DT_NS, chain.noise)
    generator = np.random.default_rng(0)
    rise = generator.uniform(20, 90, (RAMPS, 1))
    ramps = np.clip((np.arange(800) - 400) / rise + 1, 0, 1).astype(np.float32)

    def by_chain(noise: bool) -> None:
        for first in range(0, RAMPS, 512):
            windows = ramps[first : first + 512]
            energies = np.full(len(windows), FEP_KEV)
            response.translate(Batch(windows, energies, noise, generator))

    def unet(width: int, n: int) -> float:
        recipe = load_recipe("published", [f"generator.width={width}"]).at(DT_NS)
        network = Generator(PositionalUNet(recipe.cyclegan.generator, 800)).to(given.device)
        backend = NetworkBackend(network.eval(), fast.preparation, DT_NS)
        return rate(partial(backend.translate, Batch(ramps[:n])), n)

    rates = {
        "readout chain, with noise": rate(lambda: by_chain(True), RAMPS),
        "readout chain, without": rate(lambda: by_chain(False), RAMPS),
        "U-Net of width 8": unet(8, 512),
        "U-Net of recipe paper": unet(40, given.pulses),
    }
    where = f"translation, {given.device}, {given.threads} thread(s)"
    show(where, rates, "U-Net of recipe paper")


if __name__ == "__main__":
    main()
