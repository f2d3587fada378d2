"""Preparation speed on one core: compiled against a plain loop over pulses in NumPy.

Run with ``python benchmarks/preparation.py``; takes a few seconds.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cpunet.pulses.container import Pulses
from cpunet.pulses.preparation import prepare
from cpunet.recipes.schema import PreparationConfig

N_PULSES, LENGTH, REPEATS = 10_000, 1_200, 7
CONFIG = PreparationConfig(
    before_ns=6400,
    after_ns=6400,
    align_at=0.999,
    baseline_ns=3200,
    tail_ns=80,
    tail_level=0.80,
    decay_fit_ns=4800,
    padding_before_ns=3200,
    padding_after_ns=0,
    saturation_run=4,
)


def adc_traces() -> npt.NDArray[np.uint16]:
    rng = np.random.default_rng(0)
    t = np.maximum(np.arange(LENGTH) - rng.uniform(540, 580, (N_PULSES, 1)), 0)
    shape = (1 - np.exp(-((t / 25) ** 2))) * np.exp(-t / 3750)
    noise = rng.normal(0, 10, (N_PULSES, LENGTH))
    return np.asarray(14_000 + 20_000 * shape + noise, np.uint16)


def plain_loop(waveforms: npt.NDArray[np.float32]) -> None:
    t = np.arange(300)
    for trace in waveforms:
        base = trace[:200].mean(dtype=float)
        top = int(trace.argmax())
        below = np.flatnonzero(trace[:top] < base + 0.999 * (trace[top] - base))
        align = int(below[-1]) + 1
        window = trace[align - 400 : align + 400].astype(float)
        window -= window[:200].mean()
        window *= 0.80 / window[-5:].mean()
        np.polyfit(t, np.log(window[-300:]), 1)


def seconds(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def main() -> None:
    adc = adc_traces()
    waveforms = adc.astype(np.float32)
    pulses = Pulses.of(waveforms, dt_ns=16)
    prepare(pulses[:2], CONFIG, "measured")  # compiles, or loads what was compiled before
    compiled = N_PULSES / seconds(lambda: prepare(pulses, CONFIG, "measured"), REPEATS)
    converted = N_PULSES / seconds(lambda: adc.astype(np.float32), REPEATS)
    plain = 1_000 / seconds(lambda: plain_loop(waveforms[:1_000]), 3)
    print(f"compiled            {compiled:10.0f} pulses/s")
    print(f"plain NumPy loop    {plain:10.0f} pulses/s ({compiled / plain:.1f} times slower)")
    print(f"uint16 to float32   {converted:10.0f} pulses/s")


if __name__ == "__main__":
    main()
