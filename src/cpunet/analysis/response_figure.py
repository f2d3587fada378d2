"""Readout chains side by side in one picture: step, impulse, tail and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from cpunet.analysis.style import COLOURS, SPARE_COLOURS, styled
from cpunet.electronics.exponentials import Exponentials, FloatArray

STEP_NS, IMPULSE_NS, GRID_NS = 2000.0, 600.0, 1.0
_LAYOUT = (("step", "impulse"), ("residual", "impulse"), ("tail", "noise"))
_POINTS = 400  # of the tail, evenly on its logarithmic axis
_SMOOTHED = 15  # bins of the spectra of noise, which are those of a long trace


@dataclass(frozen=True, eq=False)
class Chain:
    """What is known of a readout chain in closed form.

    Parameters
    ----------
    name
        For legends.
    whole, undecayed
        The chain, and the same without its decays, so that a step ends at 1.
    frequency_mhz, noise_kev2_per_mhz
        Density of the noise power at frequencies from 0 up, evenly spaced; None if not known.
    """

    name: str
    whole: Exponentials
    undecayed: Exponentials
    frequency_mhz: FloatArray | None = None
    noise_kev2_per_mhz: FloatArray | None = None


def half_height_ns(chain: Chain) -> float:
    """When the step response reaches half of its maximum, in ns after the step."""
    time_ns = np.arange(0.0, STEP_NS, GRID_NS)
    step = chain.whole.step(time_ns)
    half = 0.5 * step.max()
    after = int((step >= half).argmax())
    return float(np.interp(half, step[after - 1 : after + 1], time_ns[after - 1 : after + 1]))


@styled
def response_figure(
    chains: Sequence[Chain], truth: Chain | None = None, *, tail_ns: float
) -> Figure:
    """Step response and its residuals, impulse response, tail, and spectrum of the noise.

    Responses are drawn from half height on, which is how pulses are aligned: a delay of
    the whole chain cannot be learned from them.  Residuals are differences from the truth,
    or from the mean of several chains if there is none.

    Parameters
    ----------
    chains
        Those learned.
    truth
        The true one, if known.
    tail_ns
        How long after the step the tail is drawn, in ns.
    """
    figure = Figure(figsize=(10.5, 8.0))
    panels = figure.subplot_mosaic(
        [list(row) for row in _LAYOUT], height_ratios=(2.2, 1.3, 2.2)
    )
    shades = [COLOURS["ren"], *SPARE_COLOURS]
    drawn = [(chain, shades[i % len(shades)], 1.2) for i, chain in enumerate(chains)]
    if truth is not None:
        # broad and beneath, so that a chain which agrees does not hide it
        drawn.insert(0, (truth, COLOURS["truth"], 3.5))
    for chain, colour, width in drawn:
        _responses(panels, chain, colour, width, tail_ns)
        _noise(panels["noise"], chain, colour, width)
    _residuals(panels["residual"], chains, truth, shades)
    _annotate(panels, has_noise=bool(panels["noise"].lines))
    return figure


def _responses(
    panels: dict[str, Axes], chain: Chain, colour: str, width: float, tail_ns: float
) -> None:
    half_ns = half_height_ns(chain)
    long_ns = np.arange(-100.0, STEP_NS, GRID_NS)
    short_ns = np.arange(-150.0, IMPULSE_NS, GRID_NS)
    tail = np.geomspace(100.0, tail_ns, _POINTS)
    look = {"color": colour, "linewidth": width}
    panels["step"].plot(long_ns, chain.whole.step(long_ns + half_ns), label=chain.name, **look)
    panels["impulse"].plot(short_ns, 1e3 * chain.whole.impulse(short_ns + half_ns), **look)
    panels["tail"].plot(1e-3 * tail, chain.whole.step(tail + half_ns), **look)


def _residuals(
    axes: Axes, chains: Sequence[Chain], truth: Chain | None, shades: Sequence[str]
) -> None:
    time_ns = np.arange(-100.0, STEP_NS, GRID_NS)
    steps = [chain.whole.step(time_ns + half_height_ns(chain)) for chain in chains]
    if truth is not None:
        reference, name = truth.whole.step(time_ns + half_height_ns(truth)), "truth"
    elif len(chains) > 1:
        reference, name = np.mean(steps, axis=0), "mean"
    else:
        axes.text(0.5, 0.5, "no truth given", ha="center", transform=axes.transAxes)
        axes.set(ylabel="Residual")
        return
    for i, step in enumerate(steps):
        axes.plot(time_ns, 1e3 * (step - reference), color=shades[i % len(shades)])
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(ylabel=f"Run − {name}\n[10⁻³ of full charge]")


def _noise(axes: Axes, chain: Chain, colour: str, width: float) -> None:
    if chain.frequency_mhz is None or chain.noise_kev2_per_mhz is None:
        return
    density: npt.NDArray[np.float64] = uniform_filter1d(chain.noise_kev2_per_mhz, _SMOOTHED)
    # low frequencies are not smoothed: there the spectrum is steep, and estimated as a curve
    density[:_SMOOTHED] = chain.noise_kev2_per_mhz[:_SMOOTHED]
    # the last bins reach beyond half the sampling rate
    shown = slice(1, -_SMOOTHED)
    axes.loglog(chain.frequency_mhz[shown], density[shown], color=colour, linewidth=width)


def _annotate(panels: dict[str, Axes], *, has_noise: bool) -> None:
    for name in ("step", "residual"):
        panels[name].set(xlim=(-100, STEP_NS))
    panels["step"].set(title="Step response", ylabel="Height [full charge]")
    panels["step"].tick_params(labelbottom=False)
    panels["step"].legend(loc="lower right")
    panels["residual"].set(xlabel="Time from half height [ns]")
    panels["impulse"].set(
        title="Impulse response",
        xlabel="Time from half height of the step [ns]",
        ylabel="Current [1/µs]",
    )
    panels["tail"].set(
        title="Top and tail of the step",
        xlabel="Time from half height [µs]",
        ylabel="Height [full charge]",
        xscale="log",
    )
    panels["tail"].xaxis.set_major_formatter("{x:g}")
    if has_noise:
        panels["noise"].set(
            title="Noise", xlabel="Frequency [MHz]", ylabel="Density [keV²/MHz]"
        )
        panels["noise"].xaxis.set_major_formatter("{x:g}")
    else:
        panels["noise"].set_axis_off()
