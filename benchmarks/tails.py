"""Pile-up tails in a file of raw traces: rate, spreads of slopes, and a picture.

Run with ``python benchmarks/tails.py FILE --kev-per-adc 0.0649 --picture tails.png``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from cpunet.electronics.drawn_pile_up import tail_shape
from cpunet.electronics.pile_up_tails import PileUpTails, read_baselines
from cpunet.plotting import COLOURS, DATA_FILL, styled
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import FloatArray
from cpunet.pulses.reading.files import open_pulses
from cpunet.recipes import load_recipe

Values = npt.NDArray[np.float64]

SHOWN = 12  # traces
EMPTY = 0.5  # errors: traces with smaller tails count as empty
SIGMA_PER_MAD = 1.4826


def slopes_kev(traces: FloatArray, tails: PileUpTails) -> Values:
    """Tails according to the slopes of baselines alone, an independent measure."""
    baselines = traces[:, : tails.samples].astype(float)
    return read_baselines(baselines, tails.dt_ns, tails.decay_us)[1] / tails.adc_per_kev


def spread(values: Values) -> float:
    """Robust standard deviation."""
    return SIGMA_PER_MAD * float(np.median(np.abs(values - np.median(values))))


@styled
def tails_figure(
    tails: PileUpTails, kev: Values, measured: FloatArray, flat: FloatArray
) -> Figure:
    """Distribution of the tails with the law, slopes before and after, and some traces.

    Parameters
    ----------
    tails, kev
        Pile-up tails of these traces, and the tail of each.
    measured, flat
        Traces as measured, and without their tails.
    """
    figure = Figure(figsize=(11, 3.6))
    sizes, slopes, traces = figure.subplots(1, 3)
    law, error_kev, known = tails.fit.law, tails.fit.sigma_kev, np.isfinite(kev)
    at = np.geomspace(error_kev, 0.95 * max(law.energies_kev), 60)
    shares = [100 * (kev[known] > size).mean() for size in at]
    sizes.loglog(at, shares, color=COLOURS["data"], drawstyle="steps-post", label="measured")
    label = f"law, {law.rate_khz:.2f} kHz, {law.decay_us:.1f} µs"
    sizes.loglog(at, 100 * law.share_above(at), color=COLOURS["ren"], label=label)
    sizes.set_ylim(max(30 / known.sum(), 0.01), 100)
    sizes.set(xlabel="tail at the first sample (keV)", ylabel="traces above (%)")
    sizes.legend()

    before, after = (slopes_kev(of[known], tails) for of in (measured, flat))
    noise = spread(before[np.abs(kev[known]) < EMPTY * error_kev])
    edges = np.linspace(-8 * noise, 16 * noise, 97).tolist()
    slopes.hist(before, edges, color=DATA_FILL, label="as measured")
    label = f"without tails, spread {spread(after):.2f} keV"
    slopes.hist(after, edges, histtype="step", color=COLOURS["ren"], label=label)
    slopes.plot([], [], " ", label=f"empty baselines: {noise:.2f} keV")
    slopes.set_yscale("log")
    slopes.set_ylim(0.7, 10 * len(before) ** 0.7)
    slopes.set(xlabel="tail according to the slope (keV)", ylabel="traces")
    slopes.legend(loc="upper right")

    large = np.flatnonzero(np.nan_to_num(kev) > 20 * error_kev)
    chosen = large[np.argsort(kev[large])][:: max(1, len(large) // SHOWN)][:SHOWN]
    time_us = np.arange(tails.samples) * tails.dt_ns * 1e-3
    for of, colour, label in (
        (measured, DATA_FILL, "as measured"),
        (flat, COLOURS["ren"], "without tails"),
    ):
        above = (of[chosen, : tails.samples] - tails.level_adc) / tails.adc_per_kev
        traces.plot(time_us, above.T, color=colour, lw=0.8)
        traces.plot([], [], color=colour, label=label)
    traces.set(xlabel="time (µs)", ylabel="above an empty baseline (keV)")
    traces.set_yscale("symlog", linthresh=10)
    traces.set_ylim(bottom=-10)
    traces.legend(loc="lower right")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--kev-per-adc", type=float)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    source = open_pulses(arguments.file, kev_per_adc=arguments.kev_per_adc)
    preparation = load_recipe("fast").at(16).preparation
    tails = PileUpTails.of(Baselines.of(source.blocks(4096), preparation))
    for name, value in tails.describe():
        print(f"{name}: {value}")
    raw = next(iter(source.blocks(4096)))
    kev, decay = tails.measure(raw), tail_shape(raw.length, tails.dt_ns, tails.decay_us)
    left = (np.nan_to_num(kev) * tails.adc_per_kev)[:, np.newaxis] * decay
    flat = (raw.waveforms - left).astype(np.float32)
    known, empty = np.isfinite(kev), np.abs(kev) < EMPTY * tails.fit.sigma_kev
    after = spread(slopes_kev(flat[known], tails))
    noise = spread(slopes_kev(raw.waveforms[empty], tails))
    print(f"slopes without tails {after:.2f} keV, of empty baselines {noise:.2f} keV")
    if arguments.picture:
        tails_figure(tails, kev, raw.waveforms, flat).savefig(arguments.picture, dpi=110)


if __name__ == "__main__":
    main()
