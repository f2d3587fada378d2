"""Functions of single pulses whose means a calibration compares.

Pulses are aligned at half maximum. The first principal component of their shapes is then how
early their charge begins to move: their drift time. Velocities and impurities change its
density, above all at its end. The other components and the current amplitude are evaluated in
slices of drift time. They distinguish what depends on drift time, such as the growth of the
charge cloud, from what does not: the readout.
"""

from __future__ import annotations

import numpy as np

from cpunet.training.moments import (
    Moments,
    Readings,
    Values,
    gaussian_bins,
    joined,
    products,
)

# Bins of the drift time; slices of drift time; components and current amplitude bins in each.
# For few pulses, half as many.
DENSITY, SLICES, COMPONENTS, AMPLITUDES = 24, 8, 6, 8
FEW = 700
# Widths in units of the spacing, and minimum widths: twice the effect of noise.
NARROW, WIDE = 1.0, 0.8
MIN_DENSITY, MIN_SLICE, MIN_AMPLITUDE = 0.02, 0.05, 0.008


class SlicedFunctions:
    r"""The functions of `Moments`, and further ones in slices of drift time.

    With the drift time :math:`t` and Gaussian bins of centre :math:`c_k` and width
    :math:`w_k`,

    .. math:: g_k(t) = \exp\left[-\frac{1}{2} \Big(\frac{t - c_k}{w_k}\Big)^2\right],

    the further functions are the bins of drift time, :math:`g_k(t)`, the other components in
    slices, :math:`a_i\, g_k(t)`, and the bins of the current amplitude in slices,
    :math:`g_j(\ln A)\, g_k(t)`.

    Parameters
    ----------
    moments
        Moments defined by the data.
    """

    def __init__(self, moments: Moments) -> None:
        self.moments = moments
        self._first = len(moments.config.segments) - 1
        drift, amplitude = moments.data.linear[:, self._first], moments.data.log_amplitude
        parts = 2 if len(moments.data) < FEW else 1
        self._components = min(COMPONENTS, moments.config.components - 1)
        # the density ends abruptly at the longest drift times
        self._density = _points(drift, DENSITY // parts, (0.01, 0.99), NARROW, MIN_DENSITY)
        self._slices = _points(drift, SLICES // parts, (0.03, 0.97), WIDE, MIN_SLICE)
        self._amplitudes = _points(
            amplitude, AMPLITUDES // parts, (0.05, 0.98), NARROW, MIN_AMPLITUDE
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the functions."""
        slices = range(1, len(self._slices[0]) + 1)
        return (
            *self.moments.names,
            *(f"drift time, bin {i + 1}" for i in range(len(self._density[0]))),
            *(f"component {c + 2}, slice {s}" for c in range(self._components) for s in slices),
            *(
                f"current amplitude, bin {a + 1}, slice {s}"
                for a in range(len(self._amplitudes[0]))
                for s in slices
            ),
        )

    def __call__(self, readings: Readings, clip: float | None = None) -> Values:
        """Functions of each pulse, shape (pulses, functions).

        Parameters
        ----------
        readings
            Readings of the pulses.
        clip
            Replaces the clip of the recipe. A wider one, for simulations far from the data,
            also widens all bins.
        """
        values = self.moments.functions(readings, clip)
        wider = 1.0 if clip is None else max(1.0, clip / self.moments.config.clip)
        density, of_drift, of_amplitude = (
            (centres, wider * widths)
            for centres, widths in (self._density, self._slices, self._amplitudes)
        )
        drift, begin = values[:, self._first], self._first + 1
        slices = gaussian_bins(drift, *of_drift)
        components = values[:, begin : begin + self._components]
        amplitudes = gaussian_bins(readings.log_amplitude, *of_amplitude)
        all_of_them: Values = joined(
            [
                values,
                gaussian_bins(drift, *density),
                products(components, slices),
                products(amplitudes, slices),
            ]
        )
        return all_of_them


def _points(
    values: Values, n: int, range_: tuple[float, float], factor: float, least: float
) -> tuple[Values, Values]:
    """Equally populated centres, and a width for each."""
    centres = np.quantile(values, np.linspace(*range_, n))
    gaps = np.diff(centres)
    between = np.concatenate([gaps[:1], np.minimum(gaps[1:], gaps[:-1]), gaps[-1:]])
    return centres, np.maximum(factor * between, least)
