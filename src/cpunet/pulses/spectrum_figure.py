"""A spectrum of energies or amplitudes with the gamma lines found in it."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from cpunet.plotting import COLOURS, DATA_FILL, styled
from cpunet.pulses.spectrum import SOURCES, Spectrum

BINS = 1000
HIGHEST = 0.999  # quantile of the values; the axis ends a little above it


@styled
def spectrum_figure(spectrum: Spectrum) -> Figure:
    """Counts on a logarithmic axis; lines found are marked, others of their source dotted.

    Amplitudes have a second axis in keV if a calibration is suggested.
    """
    figure = Figure(figsize=(9.0, 4.2))
    axes = figure.subplots()
    values = spectrum.values[np.isfinite(spectrum.values)]
    top = 1.05 * float(np.quantile(values, HIGHEST)) if len(values) else 1.0
    bins = min(BINS, max(200, len(values) // 10))
    counts, edges = np.histogram(values, bins, (0.0, max(top, 1e-9)))
    axes.stairs(counts, edges, fill=True, color=DATA_FILL)
    axes.stairs(counts, edges, color=COLOURS["data"], linewidth=0.6)
    unit = "keV" if spectrum.in_kev else "ADC counts"
    axes.set(
        xlabel=f"Energy [{unit}]"
        if spectrum.in_kev
        else f"Amplitude over the baseline [{unit}]",
        ylabel=f"Pulses / {edges[1] - edges[0]:.3g} {unit} (logarithmic)",
        yscale="log",
        xlim=(0.0, edges[-1]),
        ylim=(0.5, 10.0 * max(counts.max(), 1)),
    )
    found = spectrum.found
    if found is not None:
        for line in sorted(SOURCES.get(found.source, found.lines_kev)):
            place, sure = line / found.kev_per_adc, line in found.lines_kev
            if place > edges[-1]:
                continue
            axes.axvline(place, color=COLOURS["raw"], lw=0.8, ls="-" if sure else ":", zorder=0)
            axes.annotate(
                f"{line:.0f}" if sure else f"({line:.0f})",
                (place, 0.98),
                xycoords=("data", "axes fraction"),
                rotation=90,
                ha="right",
                va="top",
                color=COLOURS["raw"],
            )
        if not spectrum.in_kev:
            factor = found.kev_per_adc
            above = axes.secondary_xaxis(
                "top",
                functions=(lambda v: np.multiply(v, factor), lambda v: np.divide(v, factor)),
            )
            above.set_xlabel(f"Energy [keV] with {factor:.4g} keV per ADC count")
    return figure
