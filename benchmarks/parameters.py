"""Pulse parameters on one core: ours, dspeed's processors on whole pulses, and a plain loop.

Run with ``python benchmarks/parameters.py``; takes about half a minute.  The plain loop goes
pulse by pulse, as a reader of the paper would write it.  The floor is the time to read and
write all pulses once; any calculation must do at least half of this.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from dspeed.processors import (
    avg_current,
    interpolated_time_point_thresh,
    min_max,
    moving_window_multi,
    upsampler,
)

from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.parameters import pulse_parameters
from cpunet.pulses.shape_parameters import all_parameters
from cpunet.recipes import load_recipe

N, PLAIN, REPEATS = 20_000, 500, 5
DT_NS, DECAY_SAMPLES, TAIL = 16.0, 3400, 300


def prepared() -> FloatArray:
    """Pulses of 800 samples with a decay and noise of 0.1 %."""
    rng = np.random.default_rng(0)
    after = np.arange(800) - rng.uniform(340, 380, (N, 1))
    edge = 1 / (1 + np.exp(-after / rng.uniform(4, 12, (N, 1))))
    pulses = edge * np.exp(-np.maximum(after, 0) / DECAY_SAMPLES)
    return (pulses + rng.normal(0, 1e-3, pulses.shape)).astype(np.float32)


def with_dspeed(waveforms: FloatArray) -> None:
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


def plain_loop(waveforms: FloatArray) -> None:
    """The same, pulse by pulse in NumPy."""
    box, samples = np.ones(48) / 48, np.arange(TAIL)
    fine = np.arange(0, 799, 1 / 16)
    for pulse in waveforms:
        current = np.interp(fine, np.arange(799), np.diff(pulse))
        for _ in range(3):
            current = np.convolve(current, box, "same")
        current.max()
        top = int(pulse.argmax())
        below = int(np.flatnonzero(pulse[:top] < 0.01 * pulse[top])[-1])
        np.interp(0.01 * pulse[top], pulse[below : below + 2], [below, below + 1])
        np.polyfit(samples, np.log(pulse[-TAIL:]), 1)


def rate(work: Callable[[], object], n: int) -> float:
    """Pulses per second, the median of a few runs."""
    work()  # compiles, or loads what was compiled before
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return n / float(np.median(times))


def main() -> None:
    recipe = load_recipe("fast").at(16)
    waveforms = prepared()
    pulses = Pulses.of(waveforms, dt_ns=DT_NS)
    settings = recipe.preparation, recipe.scores
    ours = rate(lambda: pulse_parameters(pulses, *settings), N)
    everything = rate(lambda: all_parameters(pulses[:4000], *settings), 4000)
    whole = rate(lambda: with_dspeed(waveforms[:4000]), 4000)
    plain = rate(lambda: plain_loop(waveforms[:PLAIN]), PLAIN)
    copied = rate(waveforms.copy, N)
    for name, value in (
        ("three parameters, ours", ours),
        ("  dspeed on whole pulses", whole),
        ("  plain loop in NumPy", plain),
        ("all twenty parameters, ours", everything),
        ("floor: pulses copied", copied),
    ):
        slower = f" ({ours / value:.1f} times slower)" if name.startswith(" ") else ""
        print(f"{name:<30}{value:>10,.0f} pulses/s{slower}")


if __name__ == "__main__":
    main()
