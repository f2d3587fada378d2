"""Pile-up tails in a file of raw traces: rate, spreads of slopes, and a picture.

Run with ``python benchmarks/tails.py FILE --kev-per-adc 0.0649 --picture tails.png``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from cpunet.electronics.pile_up_tails import PileUpTails
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.reading.opening import open_pulses
from cpunet.recipes import load_recipe
from cpunet.validation.remains_figure import Slopes, remains_figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--kev-per-adc", type=float)
    parser.add_argument("--decay-us", type=float)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    source = open_pulses(arguments.file, kev_per_adc=arguments.kev_per_adc)
    preparation = load_recipe("fast").preparation
    tails = PileUpTails.of(Baselines.of(source.blocks(4096), preparation), arguments.decay_us)
    raw = next(iter(source.blocks(4096)))
    console = Console()
    for name, value in tails.describe().items():
        console.print(f"{name}: {value}")
    after, noise = Slopes.of(raw, tails).spreads
    console.print(f"slopes without tails {after:.2f} keV, of empty baselines {noise:.2f} keV")
    if arguments.picture:
        remains_figure(raw, tails).savefig(arguments.picture, dpi=110)


if __name__ == "__main__":
    main()
