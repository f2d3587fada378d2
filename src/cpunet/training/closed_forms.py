"""Readout chains in closed form, fitted or true: sums of exponentials, numbers, one figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from cpunet.electronics.chain import Decay, Electronics
from cpunet.electronics.exponentials import Exponentials, FloatArray, moved_apart
from cpunet.electronics.readout import noise_power
from cpunet.networks.generators import NOISE_BINS, ResponseGenerator
from cpunet.networks.response_layer import ElectronicsResponse
from cpunet.plotting import COLOURS, SPARE_COLOURS, styled
from cpunet.recipes.schema import PreparationConfig

Numbers = dict[str, float]

STEP_NS, IMPULSE_NS, GRID_NS = 2000.0, 600.0, 1.0
_FINE_NS, _SHORTEST_NS = 0.5, 10_000.0  # step and minimum length of step responses
_RISES = {"rise_10_90_ns": 0.1, "rise_1_99_ns": 0.01, "rise_0.1_99.9_ns": 0.001}
# Range in which a spectrum is flat, in units of half the sampling rate, and smoothing bins.
_PLATEAU, _SMOOTHED = (0.03, 0.1), 41
_LAYOUT = (("step", "impulse"), ("residual", "impulse"), ("tail", "noise"))
_POINTS = 400  # of the tail, equidistant on the logarithmic axis
_BINS = 150  # of the noise spectra


@dataclass(frozen=True, eq=False)
class Chain:
    """A readout chain in closed form.

    Parameters
    ----------
    name
        Name in legends.
    whole, undecayed
        The chain, and the chain without its decays, whose step response ends at 1.
    frequency_mhz, noise_kev2_per_mhz
        Equally spaced frequencies from 0 in MHz and noise power density in keV²/MHz; None if
        unknown.
    """

    name: str
    whole: Exponentials
    undecayed: Exponentials
    frequency_mhz: FloatArray | None = None
    noise_kev2_per_mhz: FloatArray | None = None


def chain_numbers(chain: Chain, preparation: PreparationConfig, dt_ns: float) -> Numbers:
    """Parametrisation-independent numbers, by which fitted and true chains are compared.

    Parameters
    ----------
    chain
        Fitted or true chain.
    preparation, dt_ns
        Preparation settings and sampling period in ns, which define the window in which the
        decay is visible.

    Returns
    -------
    dict
        Values by name, with the unit as suffix.  ``rise_…_ns``: rise times of the step
        response between fractions of its maximum.  ``missing_…_ns``: fraction of the charge
        that has not arrived, and ``overshoot``, both without decays.
        ``effective_decay_us``: from the slope of the logarithm over the fitted tail.
        ``droop_…_us``: fraction that has decayed.  ``noise_rms_kev`` and
        ``noise_corner_mhz``, the frequency at which the noise power falls to half.
    """
    end_ns = reaches_ns(chain, preparation.align_fraction) + preparation.samples_after * dt_ns
    time_ns = np.arange(0, max(end_ns, _SHORTEST_NS), _FINE_NS)
    step, undecayed = chain.whole.step(time_ns), chain.undecayed.step(time_ns)
    numbers = {
        name: _reaches_ns(step, 1 - low) - _reaches_ns(step, low)
        for name, low in _RISES.items()
    }
    for time in (500, 1000):
        numbers[f"missing_{time}_ns"] = float(1 - chain.undecayed.step(time))
    numbers["overshoot"] = max(0.0, float(undecayed.max()) - 1)
    tail_ns = np.arange(end_ns - preparation.decay_fit_samples * dt_ns, end_ns, dt_ns)
    slope = np.polyfit(tail_ns, np.log(np.maximum(chain.whole.step(tail_ns), 1e-3)), 1)[0]
    if slope < 0:
        numbers["effective_decay_us"] = float(-1e-3 / slope)
    for time_us in (1, 5):
        left = chain.whole.step(1e3 * time_us) / chain.undecayed.step(1e3 * time_us)
        numbers[f"droop_{time_us}_us"] = float(1 - left)
    return numbers | noise_numbers(chain)


def reaches_ns(chain: Chain, fraction: float) -> float:
    """Time in ns after a step at which its response reaches a fraction of its maximum."""
    return _reaches_ns(chain.whole.step(np.arange(0, _SHORTEST_NS, _FINE_NS)), fraction)


@styled
def response_figure(
    chains: Sequence[Chain], truth: Chain | None = None, *, tail_ns: float
) -> Figure:
    """Step response and its residuals, impulse response, tail, and spectrum of the noise.

    Times are counted from half height, by which pulses are aligned: an overall delay of the
    chain cannot be inferred from them.  Residuals are differences from the truth, or from
    the mean of several chains if there is no truth; a single chain has none.

    Parameters
    ----------
    chains
        Fitted chains.
    truth
        True chain, if known.
    tail_ns
        Time after the step up to which the tail is drawn, in ns.
    """
    compared = truth is not None or len(chains) > 1
    rows = [row for row in _LAYOUT if compared or "residual" not in row]
    heights = [1.3 if "residual" in row else 2.2 for row in rows]
    figure = Figure(figsize=(10.5, 2.4 + sum(heights)))
    panels = figure.subplot_mosaic([list(row) for row in rows], height_ratios=heights)
    shades = [COLOURS["ren"], *SPARE_COLOURS]
    drawn = [(chain, shades[i % len(shades)], 1.2) for i, chain in enumerate(chains)]
    if truth is not None:
        # a broad line underneath, so that a chain which agrees does not hide it
        drawn.insert(0, (truth, COLOURS["truth"], 3.5))
    for chain, colour, width in drawn:
        _responses(panels, chain, colour, width, tail_ns)
        _noise(panels["noise"], chain, colour, width)
    if compared:
        _residuals(panels["residual"], chains, truth, shades)
    _annotate(panels, has_noise=bool(panels["noise"].lines))
    return figure


def _responses(
    panels: dict[str, Axes], chain: Chain, colour: str, width: float, tail_ns: float
) -> None:
    half_ns = reaches_ns(chain, 0.5)
    long_ns = np.arange(-100.0, STEP_NS, GRID_NS)
    short_ns = np.arange(-150.0, IMPULSE_NS, GRID_NS)
    tail = np.geomspace(100.0, tail_ns, _POINTS)
    look: dict[str, Any] = {"color": colour, "linewidth": width}
    panels["step"].plot(long_ns, chain.whole.step(long_ns + half_ns), label=chain.name, **look)
    panels["impulse"].plot(short_ns, 1e3 * chain.whole.impulse(short_ns + half_ns), **look)
    panels["tail"].plot(1e-3 * tail, chain.whole.step(tail + half_ns), **look)


def _residuals(
    axes: Axes, chains: Sequence[Chain], truth: Chain | None, shades: Sequence[str]
) -> None:
    time_ns = np.arange(-100.0, STEP_NS, GRID_NS)
    steps = [chain.whole.step(time_ns + reaches_ns(chain, 0.5)) for chain in chains]
    if truth is not None:
        reference, name = truth.whole.step(time_ns + reaches_ns(truth, 0.5)), "truth"
    else:
        reference, name = np.mean(steps, axis=0), "mean"
    for i, step in enumerate(steps):
        axes.plot(time_ns, 1e3 * (step - reference), color=shades[i % len(shades)])
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(ylabel=f"Run − {name}\n[10⁻³ of full charge]")


def _noise(axes: Axes, chain: Chain, colour: str, width: float) -> None:
    if chain.frequency_mhz is None or chain.noise_kev2_per_mhz is None:
        return
    # equidistant on the logarithmic axis: low frequencies individually, high ones averaged
    stop = len(chain.frequency_mhz) - 1
    edges = np.unique(np.geomspace(1, stop, _BINS).astype(int))
    frequency, density = (
        np.add.reduceat(values[:stop], edges[:-1]) / np.diff(edges)
        for values in (chain.frequency_mhz, chain.noise_kev2_per_mhz)
    )
    axes.loglog(frequency, density, color=colour, linewidth=width)


def _annotate(panels: dict[str, Axes], *, has_noise: bool) -> None:
    steps = [panels[name] for name in ("step", "residual") if name in panels]
    for axes in steps:
        axes.set(xlim=(-100, STEP_NS))
        axes.tick_params(labelbottom=axes is steps[-1])
    steps[-1].set(xlabel="Time from half height [ns]")
    panels["step"].set(title="Step response", ylabel="Height [full charge]")
    panels["step"].legend(loc="lower right")
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


def noise_numbers(chain: Chain) -> Numbers:
    """RMS and corner of a chain's noise, see `chain_numbers`; empty if unknown."""
    frequency, density = chain.frequency_mhz, chain.noise_kev2_per_mhz
    if frequency is None or density is None:
        return {}
    # frequency 0 is the baseline; the last one represents half a step
    numbers = {
        "noise_rms_kev": float(np.sqrt((density[1:-1].sum() + density[-1] / 2) * frequency[1]))
    }
    low, high = (part * frequency[-1] for part in _PLATEAU)
    plateau = np.median(density[(frequency >= low) & (frequency <= high)])
    smooth = uniform_filter1d(density, _SMOOTHED)
    fallen = (smooth < 0.5 * plateau) & (frequency > high)
    if fallen.any():
        numbers["noise_corner_mhz"] = float(frequency[fallen.argmax()])
    return numbers


def _reaches_ns(step: FloatArray, fraction: float) -> float:
    """Time at which a step response on the grid first reaches a fraction of its maximum."""
    level = fraction * step.max()
    after = max(1, int((step >= level).argmax()))
    low, high = step[after - 1], step[after]
    return _FINE_NS * (after - 1 + float((level - low) / (high - low)))


_MIN_SLOW = 0.005  # share of the charge below which a mean time is meaningless
_FOREVER_US = 1e9  # decay time of a chain without decay


def learned_chain(response: ElectronicsResponse, name: str) -> Chain:
    """The closed form of a fitted chain: a sum of exponentials, like a true chain."""
    poles, main = response.log_poles_ns.exp().tolist(), response.log_decay_us.exp().item()
    slow, fast = response.slow_weights.tolist(), response.decay_weights.tolist()
    fast_ns = [1e3 * tau for tau in response.fast_times_us.tolist()]
    taus = moved_apart([*poles, *response.slow_ns.tolist(), 1e3 * main, *fast_ns])
    n, n_slow = len(poles), len(slow)
    slow_taus = taus[n : n + n_slow]
    undecayed = Exponentials.of_real(
        1 - sum(slow),
        slow_taus,
        [weight / tau for weight, tau in zip(slow, slow_taus, strict=True)],
    )
    for tau in taus[:n]:
        undecayed = undecayed * Exponentials.low_pass(tau)
    if len(response.ringing):
        undecayed = undecayed * _ringing(response)
    shares = [1 - sum(fast), *fast]
    whole = undecayed * Exponentials.decaying(shares, taus[n + n_slow :])
    return Chain(name, whole, undecayed)


def true_chain_of(electronics: Electronics) -> Chain:
    """The closed form of a true chain; its nonlinearity is left out."""
    endless = electronics.model_copy(
        update={"decays": (Decay(fraction=1, tau_us=_FOREVER_US),)}
    )
    frequency = density = None
    spectrum, dt_ns = electronics.noise.spectrum, electronics.dt_ns
    if spectrum is not None:
        samples = 2 * (NOISE_BINS - 1)
        power = noise_power(spectrum, dt_ns, samples)
        frequency = np.asarray(np.fft.rfftfreq(samples, dt_ns * 1e-3), float)
        density = electronics.noise.rms_kev**2 * power / frequency[1]
    return Chain(
        f"true response ({electronics.name})",
        electronics.transfer,
        endless.transfer,
        frequency,
        density,
    )


def with_noise(
    chain: Chain, network: ResponseGenerator, preparation: PreparationConfig
) -> Chain:
    """Add the noise, converted from the units of prepared pulses to keV."""
    noise = network.noise
    # height of a full charge whose tail has the level of prepared pulses
    tail = preparation.samples_after - 0.5 * preparation.tail_samples
    tail_ns = reaches_ns(chain, preparation.align_fraction) + tail * noise.dt_ns
    height = preparation.tail_level / float(chain.whole.step(tail_ns))
    dt_us = 1e-3 * noise.dt_ns
    return Chain(
        chain.name,
        chain.whole,
        chain.undecayed,
        np.asarray(np.fft.rfftfreq(noise.samples, dt_us), float),
        # both signs of the frequency
        2 * dt_us * noise.density / height**2,
    )


def _ringing(response: ElectronicsResponse) -> Exponentials:
    """Step response ``1 + exp(-t/damping) (a sin + b cos)``."""
    frequency_mhz, damping_ns = response.log_ringing.exp().tolist()
    sine, cosine = response.ringing.tolist()
    pole = complex(-1 / damping_ns, 2e-3 * np.pi * frequency_mhz)
    residue = 0.5 * complex(cosine, -sine) * pole
    poles = np.array([pole, pole.conjugate()])
    return Exponentials(1 + cosine, poles, np.array([residue, residue.conjugate()]))


def true_parameters(electronics: Electronics) -> Numbers:
    """Parameters of a true chain under the names of `ElectronicsResponse.describe`."""
    poles = sorted(electronics.bandwidth_poles_ns, reverse=True)
    numbers = {f"pole_{i + 1}_ns": tau for i, tau in enumerate(poles)}
    # an overshoot is a slow part of negative sign
    parts = [(electronics.slow, 1), (electronics.overshoot, -1)]
    numbers |= slow_numbers(
        [(part.tau_ns, sign * part.fraction) for part, sign in parts if part]
    )
    if ring := electronics.ringing:
        numbers["ringing"] = ring.fraction
        numbers["ringing_mhz"] = ring.frequency_MHz
        numbers["ringing_damping_ns"] = ring.damping_ns
    *fast, main = sorted(electronics.decays, key=lambda part: part.tau_us)
    numbers["decay_us"] = main.tau_us
    return numbers | {f"decay_{part.tau_us:g}_us": part.fraction for part in fast}


def slow_numbers(parts: Sequence[tuple[float, float]]) -> Numbers:
    """Total late share and its mean time, from times in ns and their shares."""
    total = sum(share for _, share in parts)
    numbers = {"slow_share": total}
    if abs(total) >= _MIN_SLOW:
        numbers["slow_time_ns"] = sum(tau * share for tau, share in parts) / total
    return numbers
