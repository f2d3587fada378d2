"""Pile-up tails in a file of raw traces: rate, spreads of slopes, and a picture.

Run with ``python benchmarks/tails.py FILE --kev-per-adc 0.0649 --picture tails.png``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console

from cpunet.electronics.drawn_pile_up import TailsLaw, tail_shape
from cpunet.electronics.pile_up_tails import PileUpTails, read_baselines
from cpunet.plotting import COLOURS, DATA_FILL, styled
from cpunet.pulses.baselines import Baselines
from cpunet.pulses.container import FloatArray, Pulses
from cpunet.pulses.reading.files import open_pulses
from cpunet.recipes import load_recipe

Values = npt.NDArray[np.float64]

SHOWN = 12  # traces
EMPTY = 0.5  # errors: traces with smaller tails count as empty
SIGMA_PER_MAD = 1.4826


@dataclass(frozen=True, eq=False)
class Slopes:
    """Slopes of baselines in keV per decay time, an independent measure of the tails.

    Parameters
    ----------
    before, after
        Slopes before and after subtraction of the estimated tails of each trace.
    empty
        Mask of the traces with negligible tails, whose slopes are noise.
    """

    before: Values
    after: Values
    empty: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, raw: Pulses, tails: PileUpTails) -> Slopes:
        """Slopes of the raw traces whose tails can be estimated."""
        kev = tails.measure(raw)
        determined = np.isfinite(kev)
        flat = _subtracted(raw, tails)
        before, after = (
            read_baselines(
                traces.waveforms[determined, : tails.samples].astype(float),
                tails.dt_ns,
                tails.decay_us,
            )[1]
            / tails.adc_per_kev
            for traces in (raw, flat)
        )
        return cls(before, after, np.abs(kev[determined]) < EMPTY * tails.fit.sigma_kev)

    @property
    def spreads(self) -> tuple[float, float]:
        """Robust standard deviations after subtraction, and of the empty traces."""
        return _robust_std(self.after), _robust_std(self.before[self.empty])


def _robust_std(values: Values) -> float:
    return SIGMA_PER_MAD * float(np.median(np.abs(values - np.median(values))))


@styled
def tails_figure(raw: Pulses, tails: PileUpTails) -> Figure:
    """Distribution of the tails with the law, slopes before and after, and some traces.

    Parameters
    ----------
    raw
        Raw traces.
    tails
        Pile-up tails estimated from these traces, or from others of the same channel.
    """
    figure = Figure(figsize=(11, 3.6))
    sizes, slopes, traces = figure.subplots(1, 3)
    kev = tails.measure(raw)
    _sizes(sizes, kev[np.isfinite(kev)], tails.fit.law, tails.fit.sigma_kev)
    _slopes(slopes, Slopes.of(raw, tails))
    _traces(traces, raw, tails, kev)
    return figure


def _sizes(axes: Axes, kev: Values, law: TailsLaw, error_kev: float) -> None:
    at = np.geomspace(error_kev, 0.95 * max(law.energies_kev), 60)
    shares = [100 * (kev > size).mean() for size in at]
    axes.loglog(at, shares, color=COLOURS["data"], drawstyle="steps-post", label="measured")
    label = f"law, {law.rate_khz:.2f} kHz, {law.decay_us:.1f} µs"
    axes.loglog(at, 100 * law.share_above(at), color=COLOURS["ren"], label=label)
    _label_sizes(axes, len(kev))


def _label_sizes(axes: Axes, traces: int) -> None:
    axes.set_ylim(max(30 / traces, 0.01), 100)
    axes.set_xlabel("tail at the first sample (keV)")
    axes.set_ylabel("traces above (%)")
    axes.legend()


def _slopes(axes: Axes, slopes: Slopes) -> None:
    spread, noise = slopes.spreads
    edges = np.linspace(-8 * noise, 16 * noise, 97).tolist()
    axes.hist(slopes.before, edges, color=DATA_FILL, label="as measured")
    after = f"without tails, spread {spread:.2f} keV"
    axes.hist(slopes.after, edges, histtype="step", color=COLOURS["ren"], label=after)
    axes.plot([], [], " ", label=f"empty baselines: {noise:.2f} keV")
    axes.set_yscale("log")
    axes.set_ylim(0.7, 10 * len(slopes.before) ** 0.7)
    axes.set_xlabel("tail according to the slope (keV)")
    axes.set_ylabel("traces")
    axes.legend(loc="upper right")


def _traces(axes: Axes, raw: Pulses, tails: PileUpTails, kev: Values) -> None:
    large = np.flatnonzero(np.nan_to_num(kev) > 20 * tails.fit.sigma_kev)
    chosen = large[np.argsort(kev[large])][:: max(1, len(large) // SHOWN)][:SHOWN]
    flat = _subtracted(raw[chosen], tails)
    time_us = np.arange(tails.samples) * tails.dt_ns * 1e-3
    for traces, colour, label in (
        (raw.waveforms[chosen], DATA_FILL, "as measured"),
        (flat.waveforms, COLOURS["ren"], "without tails"),
    ):
        above = _in_kev(traces, tails)
        axes.plot(time_us, above[:, : tails.samples].T, color=colour, lw=0.8)
        axes.plot([], [], color=colour, label=label)
    axes.set_xlabel("time (µs)")
    axes.set_ylabel("above an empty baseline (keV)")
    axes.set_yscale("symlog", linthresh=10)
    axes.set_ylim(bottom=-10)
    axes.legend(loc="lower right")


def _subtracted(raw: Pulses, tails: PileUpTails) -> Pulses:
    """Traces with their tails subtracted; unchanged where these are undetermined."""
    decay = tail_shape(raw.length, tails.dt_ns, tails.decay_us)
    heights = np.nan_to_num(tails.measure(raw)) * tails.adc_per_kev
    flat = raw.waveforms - heights[:, np.newaxis] * decay
    return raw.with_waveforms(flat.astype(np.float32))


def _in_kev(traces: FloatArray, tails: PileUpTails) -> Values:
    return np.asarray((traces - tails.level_adc) / tails.adc_per_kev, float)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--kev-per-adc", type=float)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    source = open_pulses(arguments.file, kev_per_adc=arguments.kev_per_adc)
    preparation = load_recipe("fast").at(16).preparation
    tails = PileUpTails.of(Baselines.of(source.blocks(4096), preparation))
    raw = next(iter(source.blocks(4096)))
    console = Console()
    for name, value in tails.describe():
        console.print(f"{name}: {value}")
    after, noise = Slopes.of(raw, tails).spreads
    console.print(f"slopes without tails {after:.2f} keV, of empty baselines {noise:.2f} keV")
    if arguments.picture:
        tails_figure(raw, tails).savefig(arguments.picture, dpi=110)


if __name__ == "__main__":
    main()
