"""Simulated and measured pulses overlaid, with the distributions of two parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cpunet.plotting import COLOURS, DATA_FILL, label, styled
from cpunet.pulses.half_maximum import align_half_maximum

Values = npt.NDArray[np.floating]

PULSES = 12  # of each side
EDGE_NS = (-500.0, 500.0)
BINS = 40


@styled
def sides_figure(
    waveforms: Mapping[str, Values],
    parameters: Mapping[str, Mapping[str, Values]],
    dt_ns: float,
    counts: Mapping[str, int],
) -> Figure:
    """Pulses aligned at half maximum with their edges (top), histograms (bottom).

    Parameters
    ----------
    waveforms
        Pulses of unit height, shape (pulses, samples), of ``"raw"`` (the simulation) and
        ``"data"``.
    parameters
        Values of two quantities by axis label and side.
    dt_ns
        Sampling period in ns.
    counts
        Number of pulses that each side has in all.
    """
    figure = Figure(figsize=(9.0, 6.0))
    (whole, edge), below = figure.subplots(2, 2)
    for side, pulses in waveforms.items():
        shown = min(len(pulses), PULSES)
        some = pulses[np.linspace(0, len(pulses) - 1, shown).astype(int)]
        length = pulses.shape[1]
        aligned = align_half_maximum(np.asarray(some, np.float32), length, length)
        time_ns = (np.arange(2 * length) - length) * dt_ns
        scales = {whole: 1e-3, edge: 1.0}  # µs, ns
        colour = COLOURS[side] if side != "data" else "0.35"
        for axes, scale in scales.items():
            lines = axes.plot(
                scale * time_ns, aligned.T, color=colour, linewidth=0.7, alpha=0.8
            )
            lines[0].set_label(f"{label(side)}, {shown} of {counts[side]}")
    whole.set_title("Pulses, aligned at half of their maximum")
    edge.set_title("Their edges")
    edge.set_xlim(*EDGE_NS)
    whole.set(xlabel="Time [µs]", ylabel="Charge / its maximum")
    edge.set(xlabel="Time [ns]", ylabel="Charge / its maximum")
    for axes, (name, values) in zip(below, parameters.items(), strict=True):
        _histograms(axes, name, values)
    figure.legend(*whole.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


def _histograms(axes: Axes, name: str, values: Mapping[str, Values]) -> None:
    everything = np.concatenate([v[np.isfinite(v)] for v in values.values()])
    low, high = np.quantile(everything, (0.002, 0.998))
    edges = np.linspace(low, high, BINS + 1)
    for side, own in values.items():
        counts = np.histogram(own, edges)[0] / max(len(own), 1)
        data = side == "data"
        axes.stairs(
            counts,
            edges,
            fill=data,
            color=DATA_FILL if data else COLOURS[side],
            label=label(side),
        )
    axes.set(xlabel=name, ylabel="Fraction of pulses")
    axes.legend()
