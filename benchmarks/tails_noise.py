"""Add tails to a closure set, and measure the noise from its baselines.

Writes the set with tails, and prints the noise density of all flat baselines, of those
selected for measuring the noise, and of those without tails. Run with
``python benchmarks/tails_noise.py CLOSURE --rate-khz 1 --decay-us 60 --out closure-tails``.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from cpunet.electronics.baseline_noise import BaselineNoise
from cpunet.electronics.chain import read_electronics
from cpunet.electronics.drawn_pile_up import TailsLaw
from cpunet.electronics.pile_up_tails import PileUpTails
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.reading.files import open_pulses
from cpunet.pulses.writing import PulseWriter
from cpunet.recipes import load_recipe

FREQUENCIES_KHZ = (20, 60, 120, 400)
LITTLE_KEV = 0.3  # smaller tails count as none


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rate-khz", type=float, default=1.0)
    parser.add_argument("--decay-us", type=float, default=60.0)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    config = load_recipe("fast").at(16).preparation
    raw = open_pulses(arguments.folder / "data.lh5").read()
    law = TailsLaw(
        arguments.rate_khz, arguments.decay_us, read_electronics("ornl").other_pulses_kev
    )
    left = law.draw(len(raw), np.random.default_rng(1))
    above = np.sort(raw.waveforms, axis=1)[:, -30:].mean(axis=1) - raw.waveforms[:, :300].mean(
        1
    )
    gain = np.median(above / raw.energy_kev)
    decay = np.exp(-np.arange(raw.length) * raw.dt_ns * 1e-3 / arguments.decay_us)
    traces = np.rint(raw.waveforms + gain * left[:, np.newaxis] * decay)
    lifted = replace(raw, waveforms=traces.clip(0, 65535).astype(np.float32))
    arguments.out.mkdir()
    with PulseWriter(arguments.out / "data.lh5", table="geds/raw") as writer:
        writer.append(lifted)
    for name in ("sim.lh5", "truth.npz"):
        shutil.copyfile(arguments.folder / name, arguments.out / name)

    console = Console()
    tails = PileUpTails.of(Baselines.of([lifted], config))
    console.print(tails.describe())
    known = np.load(arguments.folder / "data_labels.npz")["flag"] == 0
    sets = {
        "without tails": known & (left < LITTLE_KEV),
        "all": np.ones(len(raw), bool),
        "taken": tails.empty(lifted),
    }
    for name, chosen in sets.items():
        noise = BaselineNoise.of(Baselines.of([lifted], config), chosen)
        khz = np.arange(len(noise.density)) / noise.samples / noise.dt_ns * 1e6
        at = ", ".join(f"{np.interp(f, khz, noise.density):.1f}" for f in FREQUENCIES_KHZ)
        console.print(
            f"{name}: {noise.n_baselines} flat baselines; {at} at {FREQUENCIES_KHZ} kHz"
        )


if __name__ == "__main__":
    main()
